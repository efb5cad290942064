"""Checks of an output before a command loads its libraries and begins its work."""

from __future__ import annotations

import tempfile
from pathlib import Path

from splatbot.cli.paths import check_output
from splatbot.errors import InputError


def check_writable(path: Path, *, folder: bool) -> None:
    """Check that a file or a folder can be written at a path, by a nameless file in the nearest folder that exists.

    Permissions alone do not show this: root may write to each folder, but /proc takes no files.

    Raises:
        InputError: the path names something else.
        OSError: the folder or its disk is not for writing.
    """
    check_output(path, folder=folder)
    place = path.absolute() if folder else path.absolute().parent
    while not place.exists():
        place = place.parent
    try:
        with tempfile.TemporaryFile(dir=place):
            pass
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def check_new(path: Path, *, overwrite: bool) -> None:
    """Check that a path is free, or that its content may be replaced.

    Raises:
        InputError: it exists, and ``overwrite`` is not set.
    """
    if path.exists() and not overwrite:
        raise InputError("exists already.", file=path, field="--out", hint="name another one, or give --overwrite")

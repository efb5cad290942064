"""Files that are either whole or not there, also after a power failure."""

from __future__ import annotations

import errno
import os
import secrets
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import BinaryIO

from splatbot import failpoints


@contextmanager
def atomic_write(path: str | Path) -> Iterator[BinaryIO]:
    """Open a binary file that replaces ``path`` when the block ends; after an error ``path`` is unchanged."""
    target = Path(path)
    target.parent.mkdir(parents=True, exist_ok=True)
    draft = target.with_name(f".{target.name}.{secrets.token_hex(4)}.tmp")
    try:
        failpoints.reach("write")
        with draft.open("xb") as file:
            yield file
            sync(file)
        replace(draft, target)
    finally:
        draft.unlink(missing_ok=True)


def sync(file: BinaryIO, *, flushed: int = 0) -> None:
    """Flush an open file to the disk; ``flushed`` bytes at its begin were flushed earlier."""
    file.flush()
    failpoints.reach("fsync", Path(file.name), flushed)
    os.fsync(file.fileno())


def replace(draft: Path, target: Path) -> None:
    """Rename a flushed file or folder, and flush the new name to the disk."""
    failpoints.reach("rename")
    draft.replace(target)
    failpoints.reach("renamed")
    sync_folder(target.parent)


def sync_folder(folder: Path) -> None:
    """Flush the names in a folder to the disk; does nothing on Windows, where folders cannot be opened."""
    try:
        descriptor = os.open(folder, os.O_RDONLY)
    except PermissionError:
        return
    try:
        os.fsync(descriptor)
    except OSError as error:
        if error.errno not in (errno.EINVAL, errno.ENOTSUP):  # of file systems that flush no folders
            raise
    finally:
        os.close(descriptor)


def sweep_drafts(folder: Path) -> None:
    """Remove the drafts that killed processes left in a folder; no other process may write into it."""
    for draft in folder.glob(".*.tmp"):
        if draft.is_file():
            draft.unlink(missing_ok=True)

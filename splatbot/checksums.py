"""Checksums of the files of a folder, in the format of ``sha256sum -c SHA256SUMS``."""

from __future__ import annotations

import hashlib
import re
from collections.abc import Iterable
from pathlib import Path

from splatbot.atomic import atomic_write
from splatbot.errors import FormatError

NAME = "SHA256SUMS"

_LINE = re.compile(r"([0-9a-f]{64})  ([^/\n]+)\n")
_HINT = f"restore it from a copy; if you changed it on purpose, delete {NAME} next to it"


def write_sums(folder: Path, names: Iterable[str], *, also: Iterable[str] = ()) -> None:
    """Write the checksums of files of a folder.

    Args:
        also: lines of :func:`sum_lines` that stay valid while files are being replaced.
    """
    lines = dict.fromkeys([*sum_lines(folder, names), *also])
    with atomic_write(folder / NAME) as file:
        file.write("".join(lines).encode())


def sum_lines(folder: Path, names: Iterable[str]) -> list[str]:
    """Return one line for each file that exists."""
    return [f"{_digest(folder / name)}  {name}\n" for name in sorted(names) if (folder / name).is_file()]


def read_sums(folder: Path) -> dict[str, set[str]] | None:
    """Read the checksums of a folder by file name; None if the file is missing.

    Raises:
        FormatError: they are damaged.
    """
    path = folder / NAME
    try:
        text = path.read_bytes().decode("ascii")
    except FileNotFoundError:
        return None
    except (OSError, UnicodeDecodeError) as error:
        raise FormatError(f"is damaged ({error}).", file=path, hint=_HINT) from error
    if not text or _LINE.sub("", text):
        raise FormatError("is damaged: a line is no checksum.", file=path, hint=_HINT)
    found: dict[str, set[str]] = {}
    for digest, name in _LINE.findall(text):
        found.setdefault(name, set()).add(digest)
    return found


def check_folder(folder: Path) -> bool:
    """Check every file of a folder; return False if it has no checksums.

    Raises:
        FormatError: a file is missing, not listed or altered, or the list is damaged.
    """
    sums = read_sums(folder)
    if sums is None:
        return False
    names = {path.name for path in folder.iterdir()} - {NAME}
    for name in sorted(names ^ set(sums)):
        raise FormatError("is missing." if name in sums else "has no checksum.", file=folder / name, hint=_HINT)
    for name in sorted(names):
        _check(folder / name, sums[name])
    return True


def check_file(path: str | Path) -> None:
    """Check a file if the folder has a checksum of it.

    Raises:
        FormatError: it is altered, or the list of checksums is damaged.
    """
    path = Path(path)
    sums = read_sums(path.parent)
    if sums is not None and path.name in sums:
        _check(path, sums[path.name])


def _check(path: Path, digests: set[str]) -> None:
    if _digest(path) not in digests:
        raise FormatError("is damaged: its checksum does not fit.", file=path, hint=_HINT)


def _digest(path: Path) -> str:
    try:
        with path.open("rb") as file:
            return hashlib.file_digest(file, "sha256").hexdigest()
    except OSError as error:
        raise FormatError(f"cannot be read ({error.strerror}).", file=path, hint="check the disk") from error

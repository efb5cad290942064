"""Files that are either whole or not there, also after a power failure."""

from __future__ import annotations

import errno
import os
import secrets
import shutil
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
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
    except OSError as error:
        raise _about(target, draft, error) from error
    finally:
        with suppress(OSError):  # a mount that has vanished
            draft.unlink(missing_ok=True)


def replace_files(
    folder: str | Path, writers: Mapping[str, Callable[[Path], None]], *, remove: Sequence[str] = ()
) -> None:
    """Write several files, then replace those of ``folder`` in this order.

    An error while they are written, as of a full disk, leaves every file of ``folder`` as it was.

    Args:
        folder: it is created if it does not exist.
        writers: function that writes the file at a path, by the file's name.
        remove: files that describe the earlier ones; they are removed before the first is replaced.
    """
    target = Path(folder)
    target.mkdir(parents=True, exist_ok=True)
    draft = target / f".{secrets.token_hex(4)}.draft"
    try:
        draft.mkdir()
        for name, write in writers.items():
            write(draft / name)
        for name in remove:
            (target / name).unlink(missing_ok=True)
        for name in writers:
            replace(draft / name, target / name)
    except OSError as error:
        raise _about(target, draft, error) from error
    finally:
        shutil.rmtree(draft, ignore_errors=True)


def write_text(text: str) -> Callable[[Path], None]:
    """Return a writer of a text for :func:`replace_files`."""
    return write_bytes(text.encode())


def write_bytes(data: bytes) -> Callable[[Path], None]:
    """Return a writer of bytes for :func:`replace_files`."""

    def write(path: Path) -> None:
        with atomic_write(path) as file:
            file.write(data)

    return write


def _about(target: Path, draft: Path, error: OSError) -> OSError:
    """Return an error that names the caller's file; errors that name another file are returned as they are."""
    if error.errno is None or not (error.filename is None or str(error.filename).startswith(str(draft))):
        return error
    return OSError(error.errno, error.strerror, str(target))


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
    for draft in folder.glob(".*.draft"):
        shutil.rmtree(draft, ignore_errors=True)

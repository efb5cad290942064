"""Archives of recordings: only plain files that stay inside the folder, and no more bytes than expected."""

from __future__ import annotations

import errno
import gzip
import lzma
import struct
import tarfile
import zipfile
import zlib
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import IO

from splatbot.downloads.errors import ArchiveError

_CHUNK = 1 << 20
_MAX_FILES = 200_000
_MAX_HEADER = 1 << 20  # bytes of one header of a tar archive
_LINK = 0o120000
_NAMES = (errno.EEXIST, errno.EISDIR, errno.ENOTDIR, errno.ENAMETOOLONG, errno.EINVAL, errno.EILSEQ)
"""Errors that a name of an archive causes, not the disk."""
_DAMAGED = (
    *(tarfile.TarError, zipfile.BadZipFile, zipfile.LargeZipFile, gzip.BadGzipFile, zlib.error, lzma.LZMAError),
    *(struct.error, EOFError, NotImplementedError, RuntimeError, ValueError, OverflowError),
)
"""Errors of the readers; a tar archive whose headers nest without end causes RecursionError, a RuntimeError."""


def unpack(archive: Path, folder: Path, *, max_bytes: int, progress: Callable[[int], None]) -> None:
    """Unpack a .tar.gz or a .zip into a new folder.

    Args:
        archive: recognized by its first bytes.
        folder: it is created.
        max_bytes: the archive must not unpack to more [bytes].
        progress: called with the bytes that are written [bytes].

    Raises:
        ArchiveError: it is neither kind or damaged, unpacks to more, holds links or devices, or leaves the folder.
        OSError: the disk is full or not available.
    """
    folder.mkdir()
    writer = _Writer(archive, folder, max_bytes, progress)
    with archive.open("rb") as file:
        magic = file.read(4)
    with _reading(archive):
        if magic.startswith(b"\x1f\x8b"):
            _unpack_tar(archive, writer)
        elif magic == b"PK\x03\x04":
            _unpack_zip(archive, writer)
        else:
            raise _damaged(archive, f"is neither .tar.gz nor .zip: it begins with {magic!r}.")


def unpack_inner(folder: Path, *, max_bytes: int, progress: Callable[[int], None]) -> None:
    """Replace the .zip files of a folder by their content, as in the scenes of 7-Scenes, which zip each sequence.

    Raises:
        ArchiveError: as :func:`unpack`.
        OSError: the disk is full or not available.
    """
    for archive in sorted(folder.glob("*.zip")):
        writer = _Writer(archive, folder, max_bytes, progress)
        with _reading(archive):
            _unpack_zip(archive, writer)
        max_bytes = writer.left
        archive.unlink()


class _Writer:
    """Writes the files of an archive, and ends before they become too many or too large."""

    def __init__(self, archive: Path, folder: Path, max_bytes: int, progress: Callable[[int], None]) -> None:
        self.left = max_bytes
        self._archive, self._folder, self._max_bytes, self._progress = archive, folder, max_bytes, progress
        self._files = 0

    def make_folder(self, name: str) -> None:
        """Create a folder of the archive."""
        self._count()
        (self._folder / self._inside(name)).mkdir(parents=True, exist_ok=True)

    def write(self, name: str, source: IO[bytes]) -> None:
        """Copy a file of the archive; the size in its header is not trusted."""
        self._count()
        target = self._folder / self._inside(name)
        target.parent.mkdir(parents=True, exist_ok=True)
        with target.open("xb") as file:
            while chunk := source.read(_CHUNK):
                self._take(len(chunk))
                file.write(chunk)
                self._progress(self._max_bytes - self.left)

    def skip(self, padding: bytes) -> None:
        """Accept zeros after the last file."""
        self._take(len(padding))
        if padding.count(0) != len(padding):
            raise _damaged(self._archive, "is damaged: a header cannot be read.")

    def _take(self, size: int) -> None:
        self.left -= size
        if self.left < 0:
            raise _damaged(self._archive, f"unpacks to more than {self._max_bytes} bytes.")

    def _count(self) -> None:
        self._files += 1
        if self._files > _MAX_FILES:
            raise _damaged(self._archive, f"holds more than {_MAX_FILES} files.")

    def _inside(self, name: str) -> PurePosixPath:
        path = PurePosixPath(name)
        if path.is_absolute() or ".." in path.parts or "\\" in name:
            raise _damaged(self._archive, f"holds {name[:80]!r}, which leaves the folder.")
        return path


class _BoundedGzip(gzip.GzipFile):
    """Decompresses without the large reads that a tar header of a hostile size would cause."""

    def read(self, size: int | None = -1) -> bytes:
        if size is None or not 0 <= size <= _MAX_HEADER:
            raise tarfile.ReadError(f"a header has {size} bytes")
        return super().read(size)


@contextmanager
def _reading(archive: Path) -> Iterator[None]:
    try:
        yield
    except _DAMAGED as error:
        raise _damaged(archive, f"is damaged ({str(error) or type(error).__name__}).") from error
    except OSError as error:
        if error.errno in _NAMES:
            raise _damaged(archive, f"holds an impossible name ({error.strerror}).") from error
        raise


def _unpack_tar(archive: Path, writer: _Writer) -> None:
    with _BoundedGzip(archive) as stream, tarfile.open(fileobj=stream, mode="r:") as tar:
        while member := tar.next():
            if member.isdir():
                writer.make_folder(member.name)
            elif member.isreg() and not member.issparse() and (source := tar.extractfile(member)):
                writer.write(member.name, source)
            else:
                raise _damaged(archive, f"holds {member.name[:80]!r}, which is no plain file.")
            tar.members = []  # type: ignore[attr-defined]  # the list would grow with the archive
        for block in iter(lambda: stream.read(_MAX_HEADER), b""):  # up to the checksum at its end
            writer.skip(block)


def _unpack_zip(archive: Path, writer: _Writer) -> None:
    with zipfile.ZipFile(archive) as pack:
        for member in pack.infolist():
            if member.is_dir():
                writer.make_folder(member.filename)
                continue
            if (member.external_attr >> 16) & 0o170000 == _LINK or member.flag_bits & 0x1:
                raise _damaged(archive, f"holds {member.filename[:80]!r}, which is no plain file.")
            with pack.open(member) as source:
                writer.write(member.filename, source)


def _damaged(archive: Path, message: str) -> ArchiveError:
    return ArchiveError(message, file=archive, hint="fetch it again; use another mirror (--url-base) if that fails")

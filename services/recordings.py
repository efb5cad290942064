"""Recordings that clients name or send: only from allowed folders, only images and lists, nothing that explodes."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from pathlib import Path, PurePosixPath
from typing import IO, BinaryIO

from splatbot.errors import InputError, LogError
from splatbot.logs import Log, open_log
from splatbot.logs.index import read_index
from splatbot.logs.presets import PRESETS
from splatbot.services.problems import DISK_ERRORS, TooLargeError

_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".txt", ".json", ".yaml"})
_MAX_FILES = 200_000
_CHUNK = 1 << 20
_LISTS = ("rgb.txt", "depth.txt", "mask.txt")
_PNG = b"\x89PNG\r\n\x1a\n"


def open_allowed(uri: str, roots: Sequence[str], *, camera: str | None = None) -> Log:
    """Open the log that a client names: synthetic, or a folder under one of ``roots`` after resolving links.

    Raises:
        InputError: it is elsewhere, whether or not there is something.
        LogError: it cannot be opened.
    """
    if camera is not None and camera not in PRESETS:
        raise InputError(f"is {camera[:80]!r}.", field="camera", hint=f"presets: {', '.join(PRESETS)}")
    if uri.startswith("synthetic:"):
        return open_log(uri, camera=camera)
    if "\x00" not in uri and len(uri) < 4096:
        for root in (Path(root).resolve() for root in roots):
            folder = (root / uri).resolve()  # an absolute uri is used as it is
            if folder.is_relative_to(root) and folder.is_dir():
                stays_inside(folder)
                return open_log(folder, camera=camera)
    hint = "name a recording under one of the service's log roots (SPLATBOT_LOG_ROOTS), or synthetic:SCENE"
    raise InputError("is no recording that may be mapped.", field="log", hint=hint)


def unpack(
    archive: Path,
    folder: Path,
    *,
    max_bytes: int,
    max_pixels: int,
    progress: Callable[[float], None] = lambda share: None,
) -> Path:
    """Unpack an uploaded zip of a recording into ``folder``; the folder that holds its rgb.txt.

    Args:
        progress: called with the share that is done, at least once per MiB; its exceptions end the work.

    Raises:
        LogError: it is not a zip, is damaged, holds files of other kinds, or has paths that leave the archive.
        TooLargeError: it unpacks to more than ``max_bytes``, or an image has more than ``max_pixels``.
        OSError: the disk is full or not available.
    """
    try:
        with zipfile.ZipFile(archive) as pack:
            members = [member for member in pack.infolist() if not member.is_dir()]
            if len(members) > _MAX_FILES or sum(member.file_size for member in members) > max_bytes:
                raise _too_large(max_bytes)
            left, total = max_bytes, max(1, sum(member.file_size for member in members))

            def step(copied: int) -> None:
                progress(min(1.0, (max_bytes - left + copied) / total))

            for member in members:
                target = folder / _inside(member)
                target.parent.mkdir(parents=True, exist_ok=True)
                with pack.open(member) as source, target.open("xb") as file:
                    left -= _copy(source, file, left, max_bytes, step)
                check_picture(target, max_pixels)
    except (zipfile.BadZipFile, zipfile.LargeZipFile, NotImplementedError, RuntimeError, EOFError) as error:
        raise LogError("is no zip that can be unpacked.", field="upload", hint="zip the recording's folder") from error
    except FileExistsError as error:
        raise LogError("holds a file twice.", field="upload", hint="zip the recording's folder") from error
    except (OSError, struct.error, ValueError, zlib.error) as error:
        if isinstance(error, OSError) and error.errno in DISK_ERRORS:
            raise
        raise LogError("cannot be unpacked.", field="upload", hint="zip the recording's folder again") from error
    homes = sorted(folder.rglob("rgb.txt"), key=lambda path: len(path.parts))
    if not homes:
        hint = "zip a folder in TUM layout: rgb.txt, depth.txt, intrinsics.json and the images"
        raise LogError("holds no rgb.txt.", field="upload", hint=hint)
    stays_inside(homes[0].parent)
    return homes[0].parent


def stays_inside(folder: Path) -> None:
    """Refuse a recording whose lists name files outside of it.

    Raises:
        LogError: one does, or a list is damaged.
    """
    root = folder.resolve()
    for name in _LISTS:
        path = folder / name
        if not path.is_file():
            continue
        for entry in read_index(path):
            if "\x00" in entry.path or not (root / entry.path).resolve().is_relative_to(root):
                hint = "name images by their paths inside the recording"
                raise LogError("leads out of the recording.", file=path, field=f"line {entry.line}", hint=hint)


def check_picture(path: Path, max_pixels: int) -> None:
    """Refuse an image whose header declares more pixels than the limit.

    Raises:
        TooLargeError: it does.
    """
    if path.suffix.lower() not in (".png", ".jpg", ".jpeg"):
        return
    with path.open("rb") as file:
        size = picture_size(file.read(1 << 16))
    if size is not None and size[0] * size[1] > max_pixels:
        raise _too_many(size, max_pixels)


def checked_picture(data: bytes, max_pixels: int, field: str) -> bytes:
    """Return ``data`` if it is a PNG or JPEG of at most ``max_pixels``.

    Raises:
        InputError: it is neither.
        TooLargeError: it has more pixels.
    """
    size = picture_size(data)
    if size is None:
        raise InputError("is neither PNG nor JPEG.", field=field, hint="send an image file, or an array")
    if size[0] * size[1] > max_pixels:
        raise _too_many(size, max_pixels)
    return data


def picture_size(head: bytes) -> tuple[int, int] | None:
    """Return width and height from the header of a PNG or JPEG, or None for other data."""
    if head.startswith(_PNG) and len(head) >= 24:
        width, height = struct.unpack(">II", head[16:24])
        return int(width), int(height)
    if head.startswith(b"\xff\xd8"):
        return _jpeg_size(head)
    return None


def _jpeg_size(head: bytes) -> tuple[int, int] | None:
    at = 2
    while at + 9 <= len(head):
        if head[at] != 0xFF:
            return None
        kind = head[at + 1]
        if kind == 0xFF:  # fill
            at += 1
        elif 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", head[at + 5 : at + 9])
            return int(width), int(height)
        else:
            at += 2 + int.from_bytes(head[at + 2 : at + 4], "big")
    return None


def _inside(member: zipfile.ZipInfo) -> PurePosixPath:
    path = PurePosixPath(member.filename)
    bad = path.is_absolute() or ".." in path.parts or "\\" in member.filename or ":" in member.filename
    link = (member.external_attr >> 16) & 0o170000 == 0o120000
    if bad or link or member.flag_bits & 0x1:
        raise LogError(f"holds {member.filename[:80]!r}.", field="upload", hint="zip plain files by relative paths")
    if path.suffix.lower() not in _SUFFIXES:
        hint = f"remove files other than  {', '.join(sorted(_SUFFIXES))}"
        raise LogError(f"holds {member.filename[:80]!r}.", field="upload", hint=hint)
    return path


def _copy(source: IO[bytes], file: BinaryIO, left: int, max_bytes: int, step: Callable[[int], None]) -> int:
    """Copy at most ``left`` bytes: the sizes in an archive's directory may be wrong."""
    copied = 0
    step(copied)
    while chunk := source.read(_CHUNK):
        copied += len(chunk)
        if copied > left:
            raise _too_large(max_bytes)
        file.write(chunk)
        step(copied)
    return copied


def _too_large(max_bytes: int) -> TooLargeError:
    return TooLargeError(
        f"unpacks to more than {max_bytes} bytes or {_MAX_FILES} files.",
        field="upload",
        hint="send a shorter recording, or raise SPLATBOT_MAX_UNPACKED_BYTES",
    )


def _too_many(size: tuple[int, int], max_pixels: int) -> TooLargeError:
    return TooLargeError(
        f"an image of {size[0]}x{size[1]} has more than {max_pixels} pixels.",
        field="image",
        hint="send smaller images, or raise SPLATBOT_MAX_PIXELS",
    )

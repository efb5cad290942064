"""Recordings that clients name or send: only from allowed folders, only images and lists, nothing that explodes."""

from __future__ import annotations

import struct
import zipfile
import zlib
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path, PurePosixPath
from typing import IO, BinaryIO

from splatbot.errors import InputError, LogError
from splatbot.logs.calibration import read_calibration
from splatbot.logs.image_size import image_size
from splatbot.logs.index import read_index
from splatbot.logs.presets import PRESETS
from splatbot.logs.synthetic import read_options
from splatbot.services.problems import DISK_ERRORS, TooLargeError
from splatbot.services.rig_files import SUFFIXES, check_rig
from splatbot.workspace import NAME as SCENE

_SUFFIXES = frozenset({".png", ".jpg", ".jpeg", ".txt", ".json", ".yaml"})
_MAX_FILES = 200_000
_CHUNK = 1 << 20
_IMAGES = (".png", ".jpg", ".jpeg")
_BAGS = (".mcap", ".bag")  # files of recordings of ROS topics
_LISTS = ("rgb.txt", "depth.txt", "mask.txt")
_SAMPLES_A_FRAME = 4  # lines of joints and ground truth, which robots report more often than images
_MAX_URI = 4095
_COMMENTS = 1000  # lines more
_LINE_BYTES = 256
_MAX_DOCUMENT = 1 << 20  # bytes of a JSON or YAML file


def allowed_log(uri: str, roots: Sequence[str], *, camera: str | None = None, max_frames: int, max_pixels: int) -> str:
    """Return the address of the log that a client names: synthetic, or under one of ``roots``, links resolved.

    Under a root it is a folder, the file of a recording of ROS topics, or the file of a rig of such recordings.

    Raises:
        InputError: it is elsewhere, whether or not there is something.
        LogError: its lists are damaged, or lead out of it. A rig names something else than recordings under a root.
        CameraError: a camera file of a rig is damaged.
        TooLargeError: a synthetic log has more than ``max_frames`` frames, or more than ``max_pixels`` a frame. A rig
            has more than 64 KiB.
    """
    if camera is not None and camera not in PRESETS:
        raise InputError(f"is {camera[:80]!r}.", field="camera", hint=f"presets: {', '.join(PRESETS)}")
    if uri.startswith("synthetic:"):
        if len(uri) > _MAX_URI:
            raise InputError(f"has more than {_MAX_URI} characters.", field="log", hint="name fewer effects")
        options = read_options(uri)
        _check_pixels((options.width, options.height), max_pixels)
        if options.frames > max_frames:
            hint = "ask for fewer, or raise SPLATBOT_MAX_FRAMES"
            raise TooLargeError(
                f"has {options.frames} frames, at most {max_frames} are mapped.", field="log", hint=hint
            )
        return uri
    if "\x00" not in uri and len(uri) <= _MAX_URI:
        resolved = [Path(root).resolve() for root in roots]
        for root in resolved:
            place = (root / uri).resolve()  # an absolute uri is used as it is
            if not place.is_relative_to(root):
                continue
            if place.suffix.lower() in SUFFIXES and place.is_file():
                check_camera = partial(check_camera_file, max_pixels=max_pixels)
                check_rig(place, resolved, is_recording=_is_recording, check_camera=check_camera)
                return str(place)
            if _is_recording(place):
                return str(place)
    hint = "name a recording or a rig under one of the service's log roots (SPLATBOT_LOG_ROOTS), or synthetic:SCENE"
    raise InputError("is no recording that may be mapped.", field="log", hint=hint)


def _is_recording(place: Path) -> bool:
    """Return whether a place is a folder whose lists stay inside, or the file of a recording of ROS topics.

    Raises:
        LogError: a list leads out, or is damaged.
    """
    if place.is_dir():
        stays_inside(place)
        return True
    return place.is_file() and place.suffix.lower() in _BAGS


def unpack(
    archive: Path,
    folder: Path,
    *,
    max_bytes: int,
    max_pixels: int,
    max_frames: int,
    progress: Callable[[float], None] = lambda share: None,
) -> Path:
    """Unpack an uploaded zip of a recording into ``folder``; the folder that holds its rgb.txt.

    Args:
        progress: called with the share that is done, at least once per MiB; its exceptions end the work.

    Raises:
        LogError: it is not a zip, is damaged, holds files of other kinds, has paths that leave the archive, or has a
            scene with joint offsets.
        TooLargeError: it unpacks to more than ``max_bytes``, an image has more than ``max_pixels``, or a list more
            than ``max_frames`` lines.
        CameraError: the intrinsics are damaged, or cannot be those of a camera.
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
                check_file(target, max_pixels, max_frames)
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
    check_calibration(homes[0].parent, max_pixels)
    _check_scene(homes[0].parent / SCENE)
    return homes[0].parent


def _check_scene(file: Path) -> None:
    """Refuse a scene with joint offsets. An uploaded map has no scene, so its plans would be for another arm."""
    if file.is_file() and b"joint_offsets" in file.read_bytes():
        hint = "copy the folder to a log root, and name it in POST /v1/maps; or delete the offsets"
        raise LogError(f"has joint_offsets in {SCENE}, which an uploaded map does not keep.", field="upload", hint=hint)


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


def check_file(path: Path, max_pixels: int, max_lines: int) -> None:
    """Check an unpacked file by its real format and size before it is read.

    Raises:
        LogError: a file that is named as an image is neither PNG nor JPEG.
        TooLargeError: an image has too many pixels, a list too many lines, or another text is too long.
    """
    kind = path.suffix.lower()
    if kind in _IMAGES:
        with path.open("rb") as file:
            size = image_size(file)
        if size is None:
            raise LogError("is neither PNG nor JPEG.", file=path, field="upload", hint="send images as PNG or JPEG")
        _check_pixels(size, max_pixels)
    elif kind == ".txt":
        most = max_lines if path.name in _LISTS else _SAMPLES_A_FRAME * max_lines
        with path.open("rb") as file:
            lines = sum(chunk.count(b"\n") + chunk.count(b"\r") for chunk in iter(lambda: file.read(_CHUNK), b""))
        if lines > most + _COMMENTS or path.stat().st_size > _LINE_BYTES * (most + _COMMENTS):
            hint = "send a shorter recording, or raise SPLATBOT_MAX_FRAMES"
            raise TooLargeError(f"{path.name} has more than {most} lines.", field="upload", hint=hint)
    elif path.stat().st_size > _MAX_DOCUMENT:
        hint = "leave out files that do not belong to the recording"
        raise TooLargeError(f"{path.name} has more than {_MAX_DOCUMENT} bytes.", field="upload", hint=hint)


def check_calibration(folder: Path, max_pixels: int) -> None:
    """Check size and intrinsics in the recording's `intrinsics.json`, if it has one, before anything is allocated.

    Raises:
        CameraError: the file is damaged, or its values cannot be those of a camera.
        TooLargeError: images have too many pixels.
    """
    path = folder / "intrinsics.json"
    if path.is_file():
        check_camera_file(path, max_pixels)


def check_camera_file(path: Path, max_pixels: int) -> None:
    """Check a file of intrinsics before anything is allocated.

    Raises:
        CameraError: the file is damaged, or its values cannot be those of a camera.
        TooLargeError: the file is long, or images have too many pixels.
    """
    if path.stat().st_size > _MAX_DOCUMENT:
        hint = "write intrinsics alone"
        raise TooLargeError(f"{path.name} has more than {_MAX_DOCUMENT} bytes.", field="camera", hint=hint)
    camera = read_calibration(path).camera
    _check_pixels((camera.width, camera.height), max_pixels)
    camera.check_plausible()


def checked_image(data: bytes, max_pixels: int, field: str) -> bytes:
    """Return ``data`` if it is a PNG or JPEG of at most ``max_pixels``.

    Raises:
        InputError: it is neither.
        TooLargeError: it has more pixels.
    """
    size = image_size(data)
    if size is None:
        raise InputError("is neither PNG nor JPEG.", field=field, hint="send an image file, or an array")
    _check_pixels(size, max_pixels)
    return data


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


def _check_pixels(size: tuple[int, int], max_pixels: int) -> None:
    if size[0] * size[1] > max_pixels:
        raise TooLargeError(
            f"an image of {size[0]}x{size[1]} has more than {max_pixels} pixels.",
            field="image",
            hint="send smaller images, or raise SPLATBOT_MAX_PIXELS",
        )

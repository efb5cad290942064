"""Decoding of colour, depth and mask files. Truncated and corrupt files are errors, even if a decoder accepts them."""

from __future__ import annotations

import zlib
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.errors import LogError

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8"
_AGAIN = "copy or record the image again, or remove it from the log"


def read_color(path: Path) -> NDArray[np.uint8]:
    """Read the RGB image (H, W, 3) of a PNG or JPEG; EXIF orientation is ignored, since intrinsics do not include it.

    Raises:
        LogError: the file is missing, truncated or corrupt.
    """
    return decode_color(_read(path, "colour"), path)


def decode_color(data: bytes, source: Path) -> NDArray[np.uint8]:
    """Decode the RGB image (H, W, 3) of a PNG or JPEG; ``source`` names it in errors.

    Raises:
        LogError: the image is truncated or corrupt.
    """
    image = _decode(data, source, "colour", cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def read_depth(path: Path, units_per_metre: float, *, empty: bool = False, void: int = 0) -> NDArray[np.float32]:
    """Read depth (H, W) [m], 0 where missing, from a 16-bit PNG in units or a 32-bit float TIFF in metres.

    Raises:
        LogError: the file is missing, truncated, corrupt, of another pixel type, or (unless ``empty``) without depth.
    """
    hint = "write one channel: 16-bit PNG (units of depth_scale) or 32-bit float TIFF (metres)"
    image = _one_channel(path, "depth", (np.uint16, np.float32), hint)
    return depth_in_metres(image, units_per_metre, path, empty=empty, void=void)


def depth_in_metres(
    image: NDArray[Any], units_per_metre: float, source: Path, *, empty: bool = False, void: int = 0
) -> NDArray[np.float32]:
    """Return depth (H, W) [m], 0 where missing, of an image (H, W) of uint16 in units or of float32 in metres.

    Args:
        image: the recorded depth.
        units_per_metre: unit of integers.
        source: name of the image in errors.
        empty: accept images without a valid pixel.
        void: integer that, like 0, marks missing depth.

    Raises:
        LogError: no pixel has depth, unless ``empty``.
    """
    if image.dtype == np.uint16:
        depth = np.where(image == void, 0, image).astype(np.float32) / np.float32(units_per_metre)
    else:
        depth = np.nan_to_num(image, nan=0.0, posinf=0.0, neginf=0.0)
    if not (empty or depth.any()):
        raise LogError(
            "has no valid depth: every pixel is 0 or NaN.",
            file=source,
            field="depth",
            hint="remove the frame from the log, or check the output of the sensor",
        )
    return depth


def read_mask(path: Path) -> NDArray[np.bool_]:
    """Mask (H, W), True where the image is not black.

    Raises:
        LogError: no such file, truncated, corrupt, or not one channel of 8 bits.
    """
    hint = "write a grey 8-bit PNG: white where a pixel may be used, black where not"
    return _one_channel(path, "mask", (np.uint8,), hint) > 0


def _one_channel(path: Path, field: str, types: tuple[type[np.generic], ...], hint: str) -> NDArray[Any]:
    """Decode an image (H, W) of one of the pixel types."""
    image = _decode(_read(path, field), path, field, cv2.IMREAD_UNCHANGED)
    if image.ndim != 2 or image.dtype not in types:
        channels = 1 if image.ndim == 2 else image.shape[2]
        raise LogError(f"has {channels} channel(s) of {image.dtype}.", file=path, field=field, hint=hint)
    return image


def _read(path: Path, field: str) -> bytes:
    try:
        return path.read_bytes()
    except (OSError, ValueError) as error:  # ValueError: a path with a zero byte
        raise LogError(
            f"cannot be read ({getattr(error, 'strerror', error)}).", file=path, field=field, hint=_AGAIN
        ) from error


def _decode(data: bytes, path: Path, field: str, flags: int) -> NDArray[Any]:
    damage = _damage(data)
    if damage:
        raise LogError(f"{damage}.", file=path, field=field, hint=_AGAIN)
    try:
        image = cv2.imdecode(np.frombuffer(data, np.uint8), flags)
    except cv2.error:  # some damaged headers raise, others return None
        image = None
    if image is None:
        raise LogError("is no image that can be decoded.", file=path, field=field, hint=_AGAIN)
    return image


def _damage(data: bytes) -> str:
    if not data:
        return "is empty"
    if data.startswith(_PNG):
        return _png_damage(data)
    if data.startswith(_JPEG) and data.rfind(b"\xff\xd9") <= data.rfind(b"\xff\xda"):
        return "is a truncated JPEG (no end marker)"
    return ""


def _png_damage(data: bytes) -> str:
    """Return the damage of a PNG, or an empty string: its chunks (length, type, data, CRC) must continue up to IEND."""
    at = len(_PNG)
    while at + 12 <= len(data):
        end = at + 8 + int.from_bytes(data[at : at + 4], "big")
        if end + 4 > len(data):
            break
        if zlib.crc32(memoryview(data)[at + 4 : end]) != int.from_bytes(data[end : end + 4], "big"):
            return f"is a corrupt PNG (checksum of the chunk at byte {at})"
        if data[at + 4 : at + 8] == b"IEND":
            return ""
        at = end + 4
    return f"is a truncated PNG ({len(data)} bytes)"

"""Sizes of image files from their headers, before anything is decoded. Only PNG and JPEG are known."""

from __future__ import annotations

import io
import struct
from typing import BinaryIO

_PNG = b"\x89PNG\r\n\x1a\n"
_JPEG = b"\xff\xd8\xff"
_MOST_SEGMENTS = 10_000  # before the frame header of a JPEG


def image_size(file: bytes | BinaryIO) -> tuple[int, int] | None:
    """Return width and height of a PNG or JPEG, read from its header; None for other data."""
    if isinstance(file, bytes):
        file = io.BytesIO(file)
    head = file.read(24)
    if head.startswith(_PNG) and len(head) == 24 and head[12:16] == b"IHDR":
        width, height = struct.unpack(">II", head[16:24])
        return int(width), int(height)
    return _jpeg_size(file) if head.startswith(_JPEG) else None


def _jpeg_size(file: BinaryIO) -> tuple[int, int] | None:
    """Return the size from the frame header, which may follow any number of other segments."""
    at = 2
    for _ in range(_MOST_SEGMENTS):
        file.seek(at)
        segment = file.read(9)
        if len(segment) < 9 or segment[0] != 0xFF:
            return None
        kind = segment[1]
        if kind == 0xFF:  # fill
            at += 1
        elif 0xC0 <= kind <= 0xCF and kind not in (0xC4, 0xC8, 0xCC):
            height, width = struct.unpack(">HH", segment[5:9])
            return int(width), int(height)
        else:
            at += 2 + int.from_bytes(segment[2:4], "big")
    return None

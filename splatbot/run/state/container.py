"""The state file: a JSON header and arrays, each with its checksum."""

from __future__ import annotations

import json
import struct
import zlib
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.atomic import atomic_write
from splatbot.errors import FormatError

Array = NDArray[Any]

MAGIC = b"splatbot state 1\n"
_LENGTHS = struct.Struct("<QI")  # of the header [bytes], and its CRC-32
_HINT = "restore the folder from a copy, or map the log again"


def write_container(path: Path, header: dict[str, Any], arrays: Sequence[Array]) -> None:
    """Write a new file to the disk, then replace ``path`` by it."""
    plain = [np.ascontiguousarray(array) for array in arrays]
    table = [[a.dtype.str, list(a.shape), zlib.crc32(p.data)] for a, p in zip(arrays, plain, strict=True)]
    text = json.dumps(header | {"arrays": table}, allow_nan=False).encode()
    with atomic_write(path) as file:
        file.write(MAGIC + _LENGTHS.pack(len(text), zlib.crc32(text)) + text)
        for array in plain:
            file.write(array.data if array.size else b"")


def read_container(path: Path) -> tuple[dict[str, Any], list[Array]]:
    """Read header and arrays of a state file.

    Raises:
        FormatError: The file is missing, of another format, truncated or altered.
    """
    try:
        data = path.read_bytes()
    except OSError as error:
        hint = "give a folder that `splatbot map --save-every` wrote"
        raise FormatError(f"cannot be read ({error.strerror}).", file=path, hint=hint) from error
    if not data.startswith(MAGIC):
        raise FormatError(f"begins with {data[: len(MAGIC)]!r}: no state of this version.", file=path, hint=_HINT)
    header, offset = _read_header(path, data)
    arrays = []
    for number, (dtype, shape, checksum) in enumerate(header.pop("arrays")):
        count = int(np.prod(shape, dtype=np.int64))
        size = count * np.dtype(dtype).itemsize
        part = data[offset : offset + size]
        if len(part) != size:
            raise FormatError("is cut off.", file=path, field=f"array {number}", hint=_HINT)
        if zlib.crc32(part) != checksum:
            raise FormatError("is damaged: a checksum does not fit.", file=path, field=f"array {number}", hint=_HINT)
        arrays.append(np.frombuffer(part, np.dtype(dtype)).reshape(shape).copy())
        offset += size
    return header, arrays


def _read_header(path: Path, data: bytes) -> tuple[dict[str, Any], int]:
    start = len(MAGIC) + _LENGTHS.size
    if len(data) < start:
        raise FormatError("is cut off.", file=path, field="header", hint=_HINT)
    length, checksum = _LENGTHS.unpack_from(data, len(MAGIC))
    text = data[start : start + length]
    if len(text) != length:
        raise FormatError("is cut off.", file=path, field="header", hint=_HINT)
    if zlib.crc32(text) != checksum:
        raise FormatError("is damaged: a checksum does not fit.", file=path, field="header", hint=_HINT)
    header: dict[str, Any] = json.loads(text)
    return header, start + length

"""LZFSE streams with a known size of their content (Apple, lzfse_internal.h)."""

from __future__ import annotations

import struct
from pathlib import Path
from types import ModuleType

from splatbot.errors import LogError

_STORED, _VN, _V2, _END = b"bvx-", b"bvxn", b"bvx2", b"bvx$"
_MASK = 2**20 - 1
_BLOCK = 16_384  # content [bytes] that a block of the encoder exceeds, short ones at the end aside
_SPARE_BLOCKS = 4


def raw_size(data: bytes) -> int | None:
    """Return the size [bytes] that the blocks of a stream announce, or None if the stream is damaged."""
    sizes = _block_sizes(data)
    return None if sizes is None else sum(sizes)


def decompress(data: bytes, size: int, source: Path, field: str) -> bytes:
    """Decompress a stream whose content has a known size [bytes].

    The headers of the blocks are checked first. A stream of other size or of more blocks than an encoder writes is not
    decompressed.

    Raises:
        LogError: the stream is damaged or has another size, or the package pyliblzfse is missing.
    """
    liblzfse = require_lzfse(source)
    sizes = _block_sizes(data)
    if sizes is None or sum(sizes) != size or len(sizes) > _SPARE_BLOCKS + size // _BLOCK:
        found = "is no whole LZFSE stream" if sizes is None else f"has {sum(sizes)} bytes in {len(sizes)} blocks"
        raise LogError(f"{found}, expected are {size} bytes.", file=source, field=field, hint="export it again")
    try:
        content: bytes = liblzfse.decompress(data)
    except liblzfse.error as error:
        raise LogError(f"is damaged ({error}).", file=source, field=field, hint="export it again") from error
    if len(content) != size:
        problem = f"has {len(content)} bytes, expected are {size}."
        raise LogError(problem, file=source, field=field, hint="export it again")
    return content


def require_lzfse(source: Path) -> ModuleType:
    """Import the package that decompresses LZFSE.

    Raises:
        LogError: it is not installed.
    """
    try:
        import liblzfse
    except ImportError as error:
        raise LogError(
            "needs the package pyliblzfse.", file=source, field="depth", hint="pip install 'splatbot[record3d]'"
        ) from error
    return liblzfse


def _block_sizes(data: bytes) -> list[int] | None:
    """Return the announced content [bytes] of each block up to the end mark, or None if the stream is damaged."""
    sizes: list[int] = []
    at = 0
    try:
        while (magic := data[at : at + 4]) != _END:
            (size,) = struct.unpack_from("<I", data, at + 4)
            if magic == _STORED:
                at += 8 + size
            elif magic == _VN:
                at += 12 + struct.unpack_from("<I", data, at + 8)[0]
            elif magic == _V2:
                literals, matches, rest = struct.unpack_from("<QQQ", data, at + 8)
                at += (rest & (2**32 - 1)) + (literals >> 20 & _MASK) + (matches >> 40 & _MASK)
                if rest & (2**32 - 1) < 32:  # the header itself; the position must advance
                    return None
            else:
                return None
            sizes.append(size)
    except struct.error:  # beyond the end of the data
        return None
    return sizes

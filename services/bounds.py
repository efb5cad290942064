"""Bounds of bodies and messages, checked on their bytes before objects are made of them."""

from __future__ import annotations

import numpy as np

from splatbot.services.problems import TooLargeError

MAX_DEPTH = 32
"""Lists and objects inside each other."""

INLINE_BYTES = 1 << 16
"""Bodies up to this size are decoded on the event loop; a thread decodes larger ones."""

_LIST = 4  # an empty list or object takes the memory of several numbers
_CHUNK = 1 << 20
_QUOTE, _COMMA = b'",'


def check_json(data: bytes, most: int, field: str = "body") -> None:
    """Refuse JSON with more than ``most`` values or too deep nesting; a list or object counts as four values.

    Damaged JSON is left to the parser.

    Raises:
        TooLargeError: the limit is exceeded.
    """
    openers = data.count(b"[") + data.count(b"{")  # also those in texts: an upper bound
    if openers <= MAX_DEPTH and data.count(b",") + _LIST * openers <= most:
        return
    if b"\\" in data:
        data = data.replace(b"\\\\", b"").replace(b'\\"', b"")
    values = depth = 0
    quoted = False
    for at in range(0, len(data), _CHUNK):
        chunk = np.frombuffer(data, np.uint8, min(_CHUNK, len(data) - at), at)
        inside = np.bitwise_xor.accumulate(chunk == _QUOTE) ^ quoted
        quoted = bool(inside[-1])
        chunk = chunk[~inside]
        lower = chunk | 0x20  # [ becomes {, and ] becomes }
        opens = lower == ord("{")
        depths = np.cumsum(opens.view(np.int8) - (lower == ord("}")).view(np.int8), dtype=np.int32)
        values += int(np.count_nonzero(chunk == _COMMA)) + _LIST * int(np.count_nonzero(opens))
        _check(values, depth + int(depths.max(initial=0)), most, field)
        depth += int(depths[-1]) if len(depths) else 0


def check_msgpack(data: bytes, most: int, field: str = "body") -> None:
    """Refuse msgpack with more than ``most`` values or too deep nesting; a list or map counts as four values more.

    Damaged msgpack is left to the decoder. The scan ends at the limit, so its time is bounded.

    Raises:
        TooLargeError: the limit is exceeded.
    """
    at, values = 0, 0
    left = [1]  # entries to come of each open list or map
    while left and at < len(data):
        if left[-1] == 0:
            left.pop()
            continue
        left[-1] -= 1
        kind = data[at]
        at += 1
        if kind <= 0x7F or kind >= 0xE0:
            continue
        count, at = _entries(data, kind, at)
        if count is None:
            at = _end(data, kind, at)
            continue
        values += _LIST + count
        left.append(count)
        _check(values, len(left) - 1, most, field)


def _entries(data: bytes, kind: int, at: int) -> tuple[int | None, int]:
    """Return the number of entries of a list or map, None for other kinds, and the position behind the number."""
    if kind <= 0x9F:
        return ((kind & 0x0F) * (2 if kind <= 0x8F else 1)), at
    if kind < 0xDC:
        return None, at
    size = 2 if kind in (0xDC, 0xDE) else 4
    return int.from_bytes(data[at : at + size], "big") * (2 if kind >= 0xDE else 1), at + size


def _end(data: bytes, kind: int, at: int) -> int:
    """Return the position behind a text, bytes, number or extension."""
    if kind <= 0xBF:
        return at + (kind & 0x1F)
    if kind in _LENGTHS:
        size, more = _LENGTHS[kind]
        return at + size + int.from_bytes(data[at : at + size], "big") + more
    return at + _SIZES.get(kind, 0)


# Bytes of the length of bin, ext and str, and bytes that it does not include; bytes of numbers and fixext.
_LENGTHS = {0xC4: (1, 0), 0xC5: (2, 0), 0xC6: (4, 0), 0xC7: (1, 1), 0xC8: (2, 1), 0xC9: (4, 1)}
_LENGTHS |= {0xD9: (1, 0), 0xDA: (2, 0), 0xDB: (4, 0)}
_SIZES = {0xCA: 4, 0xCB: 8} | {0xCC + i: 2**i for i in range(4)} | {0xD0 + i: 2**i for i in range(4)}
_SIZES |= {0xD4 + i: 2**i + 1 for i in range(5)}


def _check(values: int, depth: int, most: int, field: str) -> None:
    if values > most:
        hint = "send less at once, or long lists of numbers as an npy or msgpack array"
        raise TooLargeError(f"holds more than {most} values (a list counts as {_LIST}).", field=field, hint=hint)
    if depth > MAX_DEPTH:
        raise TooLargeError(f"is nested deeper than {MAX_DEPTH}.", field=field, hint="send a flatter document")

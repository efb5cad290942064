"""Encoding of rosbridge messages: JSON, CBOR, PNG, fragments; and decoding of clients' messages."""

from __future__ import annotations

import base64
import json
import math
from collections import OrderedDict
from collections.abc import Mapping
from typing import Any, Literal, get_args

import cbor2
import cv2
import numpy as np

from splatbot.errors import InputError
from splatbot.services.ros.wire import RosMessage, to_cbor, to_json

Compression = Literal["none", "png", "cbor", "cbor-raw"]

_UNFINISHED = 8  # messages in fragments that one client may have under way
_MOST_FRAGMENTS = 4096
_SMALLEST_FRAGMENT = 128


def check_compression(value: Any) -> Compression:
    """Check a compression by name.

    Raises:
        InputError: the name is unknown.
    """
    for known in get_args(Compression):
        if value == known:
            return known
    hint = f"use {', '.join(get_args(Compression))}"
    raise InputError(f"is {str(value)[:40]!r}.", field="compression", hint=hint)


def pack_published(topic: str, message: RosMessage, compression: Compression) -> str | bytes:
    """Encode a `publish` of a message."""
    if compression == "cbor-raw":
        sec, nanosec = divmod(round(message.stamp * 1e9), 10**9)
        raw = {"secs": sec, "nsecs": nanosec, "bytes": message.cdr}
        return cbor2.dumps({"op": "publish", "topic": topic, "msg": raw})
    if compression == "cbor":
        return cbor2.dumps({"op": "publish", "topic": topic, "msg": message.cbor})
    text = f'{{"op":"publish","topic":{json.dumps(topic)},"msg":{message.json}}}'
    return png_text(text) if compression == "png" else text


def pack(values: Mapping[str, Any], compression: Compression) -> str | bytes:
    """Encode any other operation."""
    if compression in ("cbor", "cbor-raw"):
        return cbor2.dumps(to_cbor(dict(values)))
    text = to_json(dict(values))
    return png_text(text) if compression == "png" else text


def png_text(text: str) -> str:
    """Encode a `png` operation: the text's bytes as the pixels of an RGB image, padded with newlines."""
    data = text.encode()
    width = max(math.isqrt(len(data) // 3), 1)
    height = math.ceil(len(data) / (3 * width))
    pixels = np.frombuffer(data.ljust(width * height * 3, b"\n"), np.uint8).reshape(height, width, 3)
    ok, png = cv2.imencode(".png", pixels[..., ::-1])
    assert ok
    return json.dumps({"op": "png", "data": base64.b64encode(png.tobytes()).decode()}, separators=(",", ":"))


def unpack_png(data: Any, most_bytes: int) -> str:
    """Decode the text of a `png` operation.

    Raises:
        InputError: it is no such image, or would unpack to more than ``most_bytes``.
    """
    wrong = InputError("is no PNG of a message.", field="data", hint="send base64 of an RGB PNG")
    try:
        png = base64.b64decode(data, validate=True)
        width, height = (int.from_bytes(png[at : at + 4], "big") for at in (16, 20))
    except (TypeError, ValueError) as error:
        raise wrong from error
    if not png.startswith(b"\x89PNG") or width * height * 3 > most_bytes:  # looked at before it is unpacked
        raise wrong
    try:
        image = cv2.imdecode(np.frombuffer(png, np.uint8), cv2.IMREAD_COLOR)
    except cv2.error as error:
        raise wrong from error
    if image is None:
        raise wrong
    try:
        return image[..., ::-1].tobytes().decode()
    except UnicodeDecodeError as error:
        raise wrong from error


def split(text: str, size: int | None, name: str) -> list[str]:
    """Split a text longer than ``size`` into ``fragment`` operations; None never splits.

    Raises:
        InputError: the size is too small.
    """
    if size is None or len(text) <= size:
        return [text]
    parts = [text[at : at + size] for at in range(0, len(text), size)]
    return [
        json.dumps({"op": "fragment", "id": name, "data": part, "num": i, "total": len(parts)})
        for i, part in enumerate(parts)
    ]


def check_fragment_size(value: Any) -> int | None:
    """Check a client's fragment size [characters]; None, or a very large one, disables fragments.

    Raises:
        InputError: it is no number, or too small.
    """
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int) or value < _SMALLEST_FRAGMENT:
        hint = f"give at least {_SMALLEST_FRAGMENT}, or leave it out"
        raise InputError(f"is {str(value)[:40]}.", field="fragment_size", hint=hint)
    return value


class Fragments:
    """Fragments of messages as they come, in any order.

    Args:
        most_characters: of all that is under way.
    """

    def __init__(self, most_characters: int) -> None:
        self._most = most_characters
        self._parts: OrderedDict[str, dict[int, str]] = OrderedDict()

    def add(self, operation: Mapping[str, Any]) -> str | None:
        """Add a fragment and return the text that it completes, if any.

        Raises:
            InputError: it makes no sense, or too much is under way.
        """
        name, num, total, data = (operation.get(key) for key in ("id", "num", "total", "data"))
        sound = isinstance(num, int) and isinstance(total, int) and isinstance(data, str) and 0 <= num < total
        if not sound or not isinstance(name, str) or total > _MOST_FRAGMENTS:  # type: ignore[operator]
            hint = f"give id, data and num < total <= {_MOST_FRAGMENTS}"
            raise InputError("makes no sense.", field="fragment", hint=hint)
        parts = self._parts.setdefault(name, {})
        parts[num] = data  # type: ignore[index, assignment]
        while len(self._parts) > _UNFINISHED:
            self._parts.popitem(last=False)
        if sum(len(part) for some in self._parts.values() for part in some.values()) > self._most:
            self._parts.clear()
            raise InputError(f"make more than {self._most} characters.", field="fragments", hint="send less at once")
        if len(parts) < total:  # type: ignore[operator]
            return None
        del self._parts[name]
        return "".join(parts[i] for i in sorted(parts))

"""Messages as bytes: CDR, rosbridge's JSON (base64, null for NaN) and CBOR (typed arrays, RFC 8746)."""

from __future__ import annotations

import base64
import json
import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from typing import Any

import cbor2
import numpy as np
from numpy.typing import NDArray

from splatbot.logs.ros_types import Message, to_cdr, to_plain

# Little-endian typed arrays of RFC 8746; bytes go as a byte string, as rosbridge has them.
_TAGS = {"u2": 69, "u4": 70, "u8": 71, "i1": 72, "i2": 77, "i4": 78, "i8": 79, "f4": 85, "f8": 86}


@dataclass(frozen=True, eq=False)
class RosMessage:
    """A message whose readers share its encodings; the first reader of a kind causes the encoding.

    Args:
        type: `pkg/msg/Name`.
        make: gives the message.
        stamp: when it was published, Unix time [s].
        latched: new readers of the topic get it too.
        client: number of the connection that it came from; 0: the service itself.
    """

    type: str
    make: Callable[[], Message]
    stamp: float
    latched: bool = False
    client: int = 0

    @cached_property
    def message(self) -> Message:
        """Not to be changed."""
        return self.make()

    @cached_property
    def cdr(self) -> bytes:
        """As ROS 2 has it on the wire."""
        return to_cdr(self.message)

    @cached_property
    def plain(self) -> dict[str, Any]:
        """As nested dictionaries with numpy arrays."""
        return to_plain(self.message)

    @cached_property
    def json(self) -> str:
        """As the text of a JSON object."""
        return to_json(self.plain)

    @cached_property
    def cbor(self) -> Any:
        """Encoded as CBOR."""
        return to_cbor(self.plain)


def to_json(value: Any) -> str:
    """Encode JSON as rosbridge writes it: bytes as base64, NaN and infinity as null."""
    return json.dumps(jsonable(value), separators=(",", ":"), allow_nan=False)


def jsonable(value: Any) -> Any:
    """Convert a value of dictionaries, lists and numpy arrays to types of JSON."""
    if isinstance(value, dict):
        return {key: jsonable(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [jsonable(entry) for entry in value]
    if isinstance(value, bytes):
        return base64.b64encode(value).decode()
    if isinstance(value, np.ndarray):
        return _array_json(value)
    if isinstance(value, np.generic):
        value = value.item()
    return None if isinstance(value, float) and not math.isfinite(value) else value


def to_cbor(value: Any) -> Any:
    """Convert a value of dictionaries, lists and numpy arrays for cbor2: typed arrays, plain bytes."""
    if isinstance(value, dict):
        return {key: to_cbor(entry) for key, entry in value.items()}
    if isinstance(value, list | tuple):
        return [to_cbor(entry) for entry in value]
    if isinstance(value, np.ndarray):
        return _array_cbor(value)
    return value.item() if isinstance(value, np.generic) else value


def _array_json(array: NDArray[Any]) -> Any:
    if array.dtype == np.uint8:
        return base64.b64encode(array.tobytes()).decode()
    if array.dtype.kind == "f" and not np.isfinite(array).all():
        return [jsonable(entry) for entry in array.tolist()]
    return array.tolist()


def _array_cbor(array: NDArray[Any]) -> Any:
    if array.dtype == np.uint8:
        return array.tobytes()
    tag = _TAGS.get(array.dtype.str[1:])
    if tag is None or array.ndim != 1:
        return to_cbor(array.tolist())
    return cbor2.CBORTag(tag, array.astype(array.dtype.newbyteorder("<"), copy=False).tobytes())

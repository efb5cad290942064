"""ROS 2 messages without ROS: construction from plain values with field checks, and CDR (rosbags' typestore)."""

from __future__ import annotations

import base64
import binascii
import dataclasses
import functools
import itertools
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from rosbags.interfaces import Nodetype
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from rosbags.typesys.store import Typestore

from splatbot.errors import InputError

Message = Any
"""An instance of one of the typestore's dataclasses; its fields are named as in the .msg file."""

_STRINGS = ("string", "wstring")
_TIMES = ("builtin_interfaces/msg/Time", "builtin_interfaces/msg/Duration")
_MOST_MESSAGES = 100_000  # in each other: an entry `{}` of a list may hold dozens
_ROS1_TIME = {"secs": "sec", "nsecs": "nanosec"}

# Types that the JAZZY store lacks: the action of ros-controls/control_msgs as topics of ROS 1's actionlib, and the
# message of RobotWebTools/tf2_web_republisher.
_JOINT_TOLERANCE = "string name\nfloat64 position\nfloat64 velocity\nfloat64 acceleration\n"
_FOLLOW = "control_msgs/msg/FollowJointTrajectory"
_STATUS = "std_msgs/Header header\nactionlib_msgs/GoalStatus status\n"
_MORE = {
    "tf2_web_republisher/msg/TFArray": "geometry_msgs/TransformStamped[] transforms\n",
    "control_msgs/msg/JointTolerance": _JOINT_TOLERANCE,
    f"{_FOLLOW}Goal": (
        "trajectory_msgs/JointTrajectory trajectory\ncontrol_msgs/JointTolerance[] path_tolerance\n"
        "control_msgs/JointTolerance[] goal_tolerance\nbuiltin_interfaces/Duration goal_time_tolerance\n"
    ),
    f"{_FOLLOW}Feedback": (
        "std_msgs/Header header\nstring[] joint_names\ntrajectory_msgs/JointTrajectoryPoint desired\n"
        "trajectory_msgs/JointTrajectoryPoint actual\ntrajectory_msgs/JointTrajectoryPoint error\n"
    ),
    f"{_FOLLOW}Result": "int32 error_code\nstring error_string\n",
    f"{_FOLLOW}ActionGoal": (
        f"std_msgs/Header header\nactionlib_msgs/GoalID goal_id\n{_FOLLOW.replace('/msg', '')}Goal goal\n"
    ),
    f"{_FOLLOW}ActionFeedback": f"{_STATUS}{_FOLLOW.replace('/msg', '')}Feedback feedback\n",
    f"{_FOLLOW}ActionResult": f"{_STATUS}{_FOLLOW.replace('/msg', '')}Result result\n",
}


@functools.cache
def typestore() -> Typestore:
    """Return the message definitions of ROS 2 Jazzy with the additional types of splatbot."""
    store = get_typestore(Stores.ROS2_JAZZY)
    for name, text in _MORE.items():
        store.register(get_types_from_msg(text, name))
    return store


def full_name(name: str) -> str:
    """Convert a type name of ROS 1 (`pkg/Name`) or ROS 2 to `pkg/msg/Name`.

    Raises:
        InputError: there is no such type.
    """
    parts = name.strip().split("/")
    full = "/".join([parts[0], "msg", parts[1]]) if len(parts) == 2 else name.strip()
    if full not in typestore().fielddefs:
        raise InputError(f"{name!r} is unknown.", field="type", hint="name a message as in sensor_msgs/msg/Image")
    return full


def type_of(message: Message) -> str:
    """Return the type `pkg/msg/Name` of a message."""
    return str(message.__msgtype__)


def definition(name: str) -> str:
    """Return the definition of a type with its dependencies (the `ros2msg` of MCAP and Foxglove)."""
    text, _ = typestore().generate_msgdef(name, ros_version=2)
    return str(text)


def to_cdr(message: Message) -> bytes:
    """Serialize a message to little-endian CDR, the wire format of ROS 2."""
    return bytes(typestore().serialize_cdr(message, type_of(message)))


def from_cdr(data: bytes | memoryview, name: str) -> Message:
    """Deserialize a message of type ``name`` from CDR."""
    return typestore().deserialize_cdr(data, name)


def build(name: str, values: Mapping[str, Any] | None = None, /, **fields: Any) -> Message:
    """Build a message of type ``name``; missing fields are 0, empty or false.

    Values may be numbers, text, arrays, lists, mappings or messages. Bytes may also be base64 text. In a list of floats
    null is NaN; elsewhere it is a missing field. Times may have ROS 1's `secs` and `nsecs`; `seq` is ignored.

    Raises:
        InputError: a field is unknown, its value is of another type, or there are more than 100,000 messages in it.
    """
    return _struct(name, {**(values or {}), **fields}, "", itertools.count())


def to_plain(message: Message) -> dict[str, Any]:
    """Convert a message to nested dictionaries; numeric arrays stay numpy arrays."""
    return {name: _plain(getattr(message, name)) for name, _ in typestore().fielddefs[type_of(message)][1]}


def _plain(value: Any) -> Any:
    if dataclasses.is_dataclass(value):
        return to_plain(value)
    if isinstance(value, list):
        return [_plain(entry) for entry in value]
    return value


def _struct(name: str, values: Any, path: str, built: Iterator[int]) -> Message:
    store = typestore()
    if next(built) >= _MOST_MESSAGES:
        raise _wrong(path, f"is one part too many: {_MOST_MESSAGES} make a message", "send less at once")
    if isinstance(values, store.types[name]):
        return values
    if not isinstance(values, Mapping):
        raise _wrong(path, f"is {_short(values)}", f"give the fields of {name}")
    renamed = {_ROS1_TIME.get(key, key): value for key, value in values.items()} if name in _TIMES else dict(values)
    if name == "std_msgs/msg/Header":
        renamed.pop("seq", None)
    fields = dict(store.fielddefs[name][1])
    unknown = sorted(str(key) for key in renamed.keys() - fields.keys())
    if unknown:
        raise _wrong(path, f"{name} has no field {unknown[0]!r}", f"its fields are {', '.join(fields)}")
    made = {
        key: _value(kind, renamed.get(key), f"{path}.{key}" if path else key, built) for key, kind in fields.items()
    }
    return store.types[name](**made)


def _value(kind: Any, value: Any, path: str, built: Iterator[int]) -> Any:
    node, what = kind
    if node is Nodetype.NAME:
        return _struct(what, {} if value is None else value, path, built)
    if node is Nodetype.BASE:
        return _base(what[0], value, path)
    (inner, inner_what), count = what
    if inner is Nodetype.BASE and inner_what[0] not in _STRINGS:
        return _numbers(inner_what[0], value, count if node is Nodetype.ARRAY else None, path)
    entries: Any = value
    if value is None:
        entries = [None] * (count if node is Nodetype.ARRAY else 0)
    if isinstance(entries, str | bytes) or not isinstance(entries, Sequence):
        raise _wrong(path, f"is {_short(value)}", "give a list")
    if node is Nodetype.ARRAY and len(entries) != count:
        raise _wrong(path, f"has {len(entries)} entries", f"give {count}")
    return [_value((inner, inner_what), entry, f"{path}[{i}]", built) for i, entry in enumerate(entries)]


def _base(kind: str, value: Any, path: str) -> Any:
    if kind in _STRINGS:
        if not isinstance(value, str | None):
            raise _wrong(path, f"is {_short(value)}", "give text")
        return value or ""
    if kind == "bool":
        if not isinstance(value, bool | np.bool_ | int | None):
            raise _wrong(path, f"is {_short(value)}", "give true or false")
        return bool(value)
    return 0 if value is None else _numbers(kind, [value], 1, path)[0].item()


def _numbers(kind: str, value: Any, count: int | None, path: str) -> Any:
    """Convert a value to numbers (N,) of a ROS type; null in a list of floats is NaN."""
    dtype = np.dtype({"byte": "uint8", "octet": "uint8", "char": "uint8", "bool": "bool"}.get(kind, kind))
    if value is None:
        return np.zeros(count or 0, dtype)
    if dtype == np.uint8 and isinstance(value, str):
        value = _unbase64(value, path)
    if dtype == np.uint8 and isinstance(value, bytes | bytearray | memoryview):
        array = np.frombuffer(value, np.uint8)
    else:
        array = _array(value, dtype, path)
    if count is not None and len(array) != count:
        raise _wrong(path, f"has {len(array)} entries", f"give {count}")
    return array


def _array(value: Any, dtype: np.dtype[Any], path: str) -> Any:
    hint = f"give {dtype} in one row"
    try:
        given = np.asarray(value) if not isinstance(value, list) or None not in value else np.asarray(value, np.float64)
    except (TypeError, ValueError, OverflowError) as error:
        raise _wrong(path, f"is {_short(value)}", hint) from error
    if given.size == 0:
        return np.zeros(0, dtype)
    whole = dtype.kind in "iu"
    if given.ndim != 1 or given.dtype.kind not in ("biu" if whole else "biuf"):
        raise _wrong(path, f"is {_short(value)}", hint)
    if whole and given.dtype != dtype:
        limits = np.iinfo(dtype)
        if int(given.min()) < limits.min or int(given.max()) > limits.max:
            raise _wrong(path, "is out of range", f"{dtype} holds {limits.min} to {limits.max}")
    with np.errstate(over="ignore"):  # a float64 beyond the range of float32 becomes infinite
        return np.ascontiguousarray(given, dtype)


def _unbase64(text: str, path: str) -> bytes:
    try:
        return base64.b64decode(text, validate=True)
    except (binascii.Error, ValueError) as error:
        raise _wrong(path, "is no base64", "encode the bytes, or send a list of numbers") from error


def _short(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= 40 else f"{text[:37]}..."


def _wrong(path: str, what: str, hint: str) -> InputError:
    return InputError(f"{what}.", field=path or "message", hint=hint)

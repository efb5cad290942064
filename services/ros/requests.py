"""Reading the nested requests of ROS services, where anything may be missing or of another type."""

from __future__ import annotations

import asyncio
import json
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.geometry import pose_from_quat
from splatbot.robots.robot import RobotModel
from splatbot.services.bounds import INLINE_BYTES, check_json

_VALUES = 1_000_000  # of one message; an image of 640 x 480 as a list of numbers has 921,600


def json_object(text: str | bytes, most_bytes: int) -> dict[str, Any]:
    """Parse a client's message as a JSON object.

    Raises:
        InputError: it is binary, too long, or no JSON object.
        TooLargeError: it has too many values or is nested too deep.
    """
    if isinstance(text, bytes):
        raise InputError("is binary.", field="message", hint="send JSON as text")
    if len(text) > most_bytes:
        raise InputError(f"has more than {most_bytes} bytes.", field="message", hint="send less at once")
    try:
        check_json(text.encode(), _VALUES, "message")
        values = json.loads(text)
    except (ValueError, RecursionError) as error:
        raise InputError("is no JSON.", field="message", hint='send {"op": ...}') from error
    if not isinstance(values, dict):
        raise InputError("is no JSON object.", field="message", hint='send {"op": ...}')
    return values


async def read_json_object(text: str | bytes, most_bytes: int) -> dict[str, Any]:
    """Parse a client's message by :func:`json_object`; a thread parses a long one, so that other clients go on."""
    if len(text) <= INLINE_BYTES:
        return json_object(text, most_bytes)
    return await asyncio.to_thread(json_object, text, most_bytes)


def entry(args: Any, path: str) -> Any:
    """Return the value at a dotted path of ``args``, or None if it is missing."""
    for key in path.split("."):
        if not isinstance(args, Mapping):
            return None
        args = args.get(key)
    return args


def has_content(value: Any) -> bool:
    """Return whether a message contains a number other than 0, a text that is not empty, or True."""
    if isinstance(value, Mapping):
        return any(has_content(part) for part in value.values())
    if isinstance(value, list):
        return any(has_content(part) for part in value)
    return bool(value)


def entries(args: Any, path: str) -> Sequence[Any]:
    """Return the list at a dotted path, empty if it is missing.

    Raises:
        InputError: there is something else.
    """
    found = entry(args, path)
    if found is None:
        return ()
    if not isinstance(found, list):
        raise InputError("is no list.", field=path, hint="give a list")
    return found


def number(args: Any, path: str, default: float = 0.0) -> float:
    """Return the number at a dotted path.

    Raises:
        InputError: it is no finite number.
    """
    value = entry(args, path)
    if value is None:
        return default
    if isinstance(value, bool) or not isinstance(value, int | float) or not np.isfinite(value):
        raise InputError(f"is {str(value)[:40]!r}.", field=path, hint="give a number")
    return float(value)


def seconds(args: Any, path: str) -> float:
    """Return a builtin_interfaces/Duration [s], 0 if it is missing."""
    return number(args, f"{path}.sec", number(args, f"{path}.secs")) + 1e-9 * number(
        args, f"{path}.nanosec", number(args, f"{path}.nsecs")
    )


def vector(args: Any, path: str) -> NDArray[np.float64]:
    """Return a geometry_msgs/Point or Vector3 (3,) [m].

    Raises:
        InputError: a coordinate is no finite number.
    """
    return np.array([number(args, f"{path}.{axis}") for axis in "xyz"])


def pose(args: Any, path: str) -> NDArray[np.float64]:
    """Return a geometry_msgs/Pose (4, 4) [m].

    Raises:
        InputError: it is missing, or its quaternion is zero.
    """
    if entry(args, path) is None:
        raise InputError("is missing.", field=path, hint="give position and orientation")
    xyzw = [number(args, f"{path}.orientation.{axis}") for axis in "xyzw"]
    try:
        return pose_from_quat(vector(args, f"{path}.position"), [xyzw[3], *xyzw[:3]])
    except ValueError as error:
        raise InputError(f"{error}.", field=f"{path}.orientation", hint="w = 1 is no rotation") from error


def joints(args: Any, path: str, robot: RobotModel) -> NDArray[np.float64]:
    """Return the configuration (J,) of a sensor_msgs/JointState in any joint order; home if it is empty.

    Raises:
        InputError: a joint of the robot is missing, or a value is no finite number.
    """
    names, values = list(entries(args, f"{path}.name")), entries(args, f"{path}.position")
    if not names and not values:
        return np.asarray(robot.home, np.float64)
    named = dict(zip(map(str, names), values, strict=False))
    missing = [name for name in robot.chain.names if name not in named]
    if missing or len(names) != len(values):
        hint = f"name {', '.join(robot.chain.names)}, each with its position"
        raise InputError(f"lacks {', '.join(missing) or 'positions'}.", field=path, hint=hint)
    return np.array([number(named, name) for name in robot.chain.names])

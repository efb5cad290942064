"""Arms by their address: ``ros:ws://host:9090/ACTION?option=value`` or ``ur:HOST?option=value``."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import fields
from typing import Any
from urllib.parse import parse_qsl, urlsplit

from splatbot.errors import InputError
from splatbot.protocols import RobotKinematics
from splatbot.robots.controllers.live import LiveOptions
from splatbot.robots.controllers.ros import RosController
from splatbot.robots.controllers.ur import UrController

_FORM = "give ros:ws://HOST:9090/joint_trajectory_controller/follow_joint_trajectory, or ur:HOST"
_TOLERANCES: Mapping[str, Callable[[str], Any]] = {each.name: float for each in fields(LiveOptions)}
_ROS: Mapping[str, Callable[[str], Any]] = {"ros": int, "states": str}
_UR: Mapping[str, Callable[[str], Any]] = dict.fromkeys(("frequency", "lookahead", "gain", "deceleration"), float)


def connect_arm(address: str, robot: RobotKinematics) -> RosController | UrController:
    """Connect the arm at an address.

    Args:
        address: see this module; the options are those of :class:`RosController`, :class:`UrController` and
            :class:`LiveOptions`.
        robot: its model.

    Raises:
        InputError: the address is malformed, or an option is unknown or no number.
        DeviceError: the arm does not answer.
    """
    kind, _, rest = address.partition(":")
    try:
        parts = urlsplit(rest)
    except ValueError as error:
        raise InputError(f"{address[:80]!r} is malformed ({error}).", field="arm", hint=_FORM) from error
    if kind == "ros" and parts.scheme in ("ws", "wss") and parts.netloc and len(parts.path) > 1:
        given, options = _options(parts.query, _ROS)
        host = f"{parts.scheme}://{parts.netloc}"
        return RosController(host, robot, action=parts.path, options=options, **given)
    if kind == "ur" and parts.path and not parts.netloc:
        given, options = _options(parts.query, _UR)
        return UrController(parts.path, robot, options=options, **given)
    raise InputError(f"{address[:80]!r} is no address of an arm.", field="arm", hint=_FORM)


def _options(query: str, own: Mapping[str, Callable[[str], Any]]) -> tuple[dict[str, Any], LiveOptions]:
    """Return the options of one kind of arm, and those of every arm."""
    known = {**own, **_TOLERANCES}
    values: dict[str, Any] = {}
    for name, text in parse_qsl(query, keep_blank_values=True):
        if name not in known:
            raise InputError(f"has no option {name[:40]!r}.", field="arm", hint=f"options: {', '.join(known)}")
        try:
            values[name] = known[name](text)
        except ValueError as error:
            raise InputError(f"is {text[:40]!r}.", field=f"arm {name}", hint="give a number") from error
    tolerances = {name: values.pop(name) for name in _TOLERANCES if name in values}
    return values, LiveOptions(**tolerances)

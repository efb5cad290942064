"""Cameras that deliver frames in real time."""

from __future__ import annotations

from splatbot.errors import InputError
from splatbot.protocols import FrameSource
from splatbot.robots.cameras import oak, realsense, replay
from splatbot.robots.cameras.oak import OakCamera
from splatbot.robots.cameras.realsense import RealsenseCamera
from splatbot.robots.cameras.replay import PREFIX, ReplayCamera

__all__ = ["PREFIX", "OakCamera", "RealsenseCamera", "ReplayCamera", "is_camera", "open_camera"]

_PREFIXES = (replay.PREFIX, oak.PREFIX, realsense.PREFIX)


def is_camera(uri: str) -> bool:
    """Return whether a URI names a camera, not a preset or a file."""
    return uri.startswith(_PREFIXES)


def open_camera(uri: str, *, joint_delay: float = 0.0) -> FrameSource:
    """Open the camera at ``uri``; it starts when its frames are iterated.

    Args:
        uri: kind and name of the camera.
        joint_delay: time [s] by which the stamps of joint positions that a camera delivers are late.

    Raises:
        InputError: the kind of camera is unknown, or an option is invalid.
    """
    if uri.startswith(replay.PREFIX):
        return ReplayCamera.from_uri(uri, joint_delay=joint_delay)
    if uri.startswith(oak.PREFIX):
        return OakCamera.from_uri(uri)
    if uri.startswith(realsense.PREFIX):
        return RealsenseCamera.from_uri(uri)
    hint = f"name one as in {oak.PREFIX}, {realsense.PREFIX} or {replay.PREFIX}recordings/desk"
    raise InputError(f"{uri!r} is unknown.", field="camera", hint=hint)

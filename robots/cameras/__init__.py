"""Cameras that deliver frames in real time."""

from __future__ import annotations

from splatbot.errors import InputError
from splatbot.protocols import FrameSource
from splatbot.robots.cameras.replay import PREFIX, ReplayCamera

__all__ = ["PREFIX", "ReplayCamera", "is_camera", "open_camera"]


def is_camera(uri: str) -> bool:
    """Return whether a URI names a camera, not a preset or a file."""
    return uri.startswith(PREFIX)


def open_camera(uri: str, *, joint_delay: float = 0.0) -> FrameSource:
    """Open the camera at ``uri``; it starts when its frames are iterated.

    Args:
        uri: kind and name of the camera.
        joint_delay: time [s] by which the stamps of joint positions that a camera delivers are late.

    Raises:
        InputError: the kind of camera is unknown, or an option is invalid.
    """
    if not is_camera(uri):
        raise InputError(f"{uri!r} is unknown.", field="camera", hint=f"name one as in {PREFIX}recordings/desk")
    return ReplayCamera.from_uri(uri, joint_delay=joint_delay)

"""Cameras that deliver frames in real time."""

from __future__ import annotations

from splatbot.errors import InputError
from splatbot.protocols import FrameSource
from splatbot.robots.cameras.replay import PREFIX, ReplayCamera

__all__ = ["ReplayCamera", "is_camera", "open_camera"]


def is_camera(uri: str) -> bool:
    """Return whether a URI names a camera, not a preset or a file."""
    return uri.startswith(PREFIX)


def open_camera(uri: str) -> FrameSource:
    """Open the camera at ``uri``; it starts when its frames are iterated.

    Raises:
        InputError: the kind of camera is unknown, or an option is invalid.
    """
    if not is_camera(uri):
        raise InputError(f"{uri!r} is unknown.", field="camera", hint=f"name one as in {PREFIX}recordings/desk")
    return ReplayCamera.from_uri(uri)

"""Cameras that deliver frames as they are taken."""

from __future__ import annotations

from splatbot.errors import InputError
from splatbot.protocols import FrameSource
from splatbot.robots.cameras.replay import PREFIX, ReplayCamera

__all__ = ["ReplayCamera", "is_camera", "open_camera"]


def is_camera(uri: str) -> bool:
    """Return True if a name is that of a camera, not of a preset or a file."""
    return uri.startswith(PREFIX)


def open_camera(uri: str) -> FrameSource:
    """Open the camera that ``uri`` names; it starts with the first requested frame.

    Raises:
        InputError: there is no such kind of camera, or an option makes no sense.
    """
    if not is_camera(uri):
        raise InputError(f"{uri!r} is unknown.", field="camera", hint=f"name one as in {PREFIX}recordings/desk")
    return ReplayCamera.from_uri(uri)

"""Cameras that deliver frames in real time."""

from __future__ import annotations

from splatbot.errors import InputError
from splatbot.layouts import OAK, OPENCV, ORBBEC, REALSENSE, REPLAY
from splatbot.protocols import FrameSource
from splatbot.robots.cameras.oak import OakCamera
from splatbot.robots.cameras.opencv import OpenCvCamera
from splatbot.robots.cameras.orbbec import OrbbecCamera
from splatbot.robots.cameras.realsense import RealsenseCamera
from splatbot.robots.cameras.replay import ReplayCamera
from splatbot.robots.cameras.rig import CameraRig

__all__ = ["CameraRig", "OakCamera", "OpenCvCamera", "OrbbecCamera", "RealsenseCamera", "ReplayCamera", "open_camera"]


def open_camera(uri: str, *, joint_delay: float = 0.0) -> FrameSource:
    """Open the camera at ``uri``; it starts when its frames are iterated.

    Args:
        uri: kind and name of the camera.
        joint_delay: time [s] by which the stamps of joint positions that a camera delivers are late.

    Raises:
        InputError: the kind of camera is unknown, or an option is invalid.
    """
    if uri.startswith(REPLAY):
        return ReplayCamera.from_uri(uri, joint_delay=joint_delay)
    if uri.startswith(OAK):
        return OakCamera.from_uri(uri)
    if uri.startswith(REALSENSE):
        return RealsenseCamera.from_uri(uri)
    if uri.startswith(ORBBEC):
        return OrbbecCamera.from_uri(uri)
    if uri.startswith(OPENCV):
        return OpenCvCamera.from_uri(uri)
    hint = f"name one as in {OAK}, {REALSENSE}, {ORBBEC}, {OPENCV}0?camera=FILE or {REPLAY}recordings/desk"
    raise InputError(f"{uri!r} is unknown.", field="camera", hint=hint)

"""Simulated table top seen by a moving and by further cameras, with exact poses."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.config import CameraConfig, PoseConfig
from splatbot.frame import Frame
from splatbot.geometry import inverse, look_at, rotation_to_quat, se3_exp
from splatbot.logs.base import LogBase
from splatbot.logs.synthetic import SyntheticLog

Array = NDArray[np.float64]

WRONG = se3_exp(np.array([0.014, -0.010, 0.010, 0.020, -0.022, 0.018]))
"""A wrong pose of a camera: 2 cm and 2 degrees."""


class FramesLog(LogBase):
    """Frames in memory as a log of one camera."""

    name, uri, ground_truth = "frames", "frames", None

    def __init__(self, frames: Sequence[Frame]) -> None:
        self._frames = frames
        self.camera = frames[0].camera

    def __len__(self) -> int:
        return len(self._frames)

    def _decode(self, index: int) -> Frame:
        return self._frames[index]


def wrist_log(frames: int, *, width: int = 320, height: int = 240, effects: str = "") -> SyntheticLog:
    """Return the recording of the first camera, which swings in front of the table."""
    return SyntheticLog(f"synthetic:tabletop?frames={frames}&width={width}&height={height}&effects={effects}")


def side_view(log: SyntheticLog, angle: float, height: float = 0.0) -> Array:
    """Return T_scene_camera (4, 4) of a view of the table from another side.

    Args:
        log: recording whose first pose is turned about the vertical axis through the table.
        angle: turn [rad].
        height: added to the height of the camera [m].
    """
    target = np.array(log.kind.stage.target)
    offset = log.ground_truth.T_world_camera[0][:3, 3] - target
    c, s = np.cos(angle), np.sin(angle)
    turned = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]]) @ offset
    return look_at(target + turned + np.array([0.0, 0.0, height]), target)


def frames_of(
    log: SyntheticLog,
    T_scene_camera: Sequence[Array],
    stamps: Iterable[float],
    name: str,
    *,
    width: int = 320,
    height: int = 180,
    sigma_depth: float = 0.0,
    seed: int = 0,
) -> list[Frame]:
    """Render the frames of a further camera with another size and lens than the first one.

    Args:
        log: recording of the scene.
        T_scene_camera: (4, 4) pose of each frame in the scene.
        stamps: their times [s].
        name: name of the camera.
        width, height: of the images [px].
        sigma_depth: standard deviation of the noise of depth at 1 m [m]; it grows with the square of depth.
        seed: of the noise.
    """
    focal = 0.9 * width
    camera = Camera(focal, 1.02 * focal, 0.49 * width, 0.52 * height, width, height)
    rng = np.random.default_rng(seed)
    frames = []
    for number, (T, stamp) in enumerate(zip(T_scene_camera, stamps, strict=True)):
        rgb, depth = log.scene.render(camera, T, stamp)
        noise = (sigma_depth * depth**2 * rng.standard_normal(depth.shape)).astype(np.float32)
        depth = np.where(depth > 0, depth + noise, np.float32(0))
        frames.append(Frame(stamp, rgb, depth, camera, number, source=f"{name} {number}", camera_name=name))
    return frames


def in_order(*streams: Iterable[Frame]) -> list[Frame]:
    """Return the frames of several cameras in the order of their stamps, numbered."""
    frames = sorted((frame for stream in streams for frame in stream), key=lambda frame: frame.stamp)
    return [replace(frame, index=index) for index, frame in enumerate(frames)]


def in_world(log: SyntheticLog, T_scene_camera: Array) -> Array:
    """Return a pose (4, 4) of the scene in the world of the map: the first camera in its first frame."""
    return inverse(log.ground_truth.T_world_camera[0]) @ T_scene_camera


def pose_config(T: Array) -> PoseConfig:
    """Return a pose (4, 4) as a configuration has it."""
    x, y, z = T[:3, 3].tolist()
    qw, qx, qy, qz = rotation_to_quat(T[:3, :3]).tolist()
    return PoseConfig(translation=(x, y, z), quaternion_wxyz=(qw, qx, qy, qz))


def estimated(T: Array, *, fixed: bool) -> CameraConfig:
    """Return a camera whose pose is known within 2 cm and 2 degrees, one standard deviation."""
    pose = pose_config(T)
    if fixed:
        return CameraConfig(T_world_camera=pose, translation_sigma=0.02, rotation_sigma=0.035)
    return CameraConfig(T_first_camera=pose, translation_sigma=0.02, rotation_sigma=0.035)

"""Rectification of frames whose rows are read at different times: the images of one instant, that of the stamp."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot import _native
from splatbot.camera import Camera
from splatbot.config import Config, SensorConfig
from splatbot.frame import Frame
from splatbot.geometry import inverse, se3_exp, se3_log
from splatbot.logs.base import DerivedLog, Log
from splatbot.trajectory import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RectifyConstants:
    """Constants of rectification."""

    max_gap: float = 0.3
    """Longest time [s] between two poses whose difference is a velocity."""


CONSTANTS = RectifyConstants()


def rectify(frame: Frame, twist: Array, sensor: SensorConfig) -> Frame:
    """Return the images that a global shutter takes at the stamp of a frame, with depth registered to colour.

    A row sees a point X s seconds after the stamp. In the camera at the stamp it is exp(s ξ) X, with the constant twist
    ξ of the camera (Hedborg et al. 2012). The depth image is resampled first; it defines the displacement of
    colour. Nothing is resampled that the sensor and the twist do not displace.

    Args:
        frame: the frame; its stamp is the time of the middle row of colour.
        twist: (6,) velocity of the camera (translation [m/s], rotation [rad/s]) in its own frame.
        sensor: readout time, and time, place and scale of depth. Its delay adds to that of the frame's stamps.
    """
    camera, velocity = frame.camera, twist.tolist()
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    moves, depth, T_color_depth = bool(np.any(twist)), frame.depth, np.array(sensor.depth_to_color)
    delay = sensor.depth_delay + frame.depth_delay
    if sensor.depth_scale != 1 or sensor.depth_bias:
        scaled = np.float32(sensor.depth_scale) * depth + np.float32(sensor.depth_bias)
        depth = np.where(depth > 0, np.maximum(scaled, 0), np.float32(0))
    if (moves and (sensor.readout or delay)) or np.any(T_color_depth):
        timing = (velocity, sensor.readout, delay)
        depth = np.asarray(_native.rectify_depth(depth, intrinsics, *timing, se3_exp(T_color_depth)))
    if not (moves and sensor.readout):
        return frame if depth is frame.depth else replace(frame, depth=depth, depth_delay=0.0 if moves else delay)
    u, v = np.moveaxis(_native.rectify_map(depth, intrinsics, velocity, sensor.readout, 0.0), -1, 0)
    rgb = cv2.remap(frame.rgb, u, v, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    mask = np.ones(depth.shape, np.uint8) if frame.mask is None else frame.mask.astype(np.uint8)
    seen = cv2.remap(mask, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0) > 0
    depth = np.where(seen, depth, np.float32(0))
    return replace(frame, rgb=np.asarray(rgb, np.uint8), depth=depth, mask=seen, depth_delay=0.0)


class RectifiedLog(DerivedLog):
    """A log with rectified frames, by the velocities of an estimated trajectory.

    Args:
        log: the log.
        config: configuration with the sensor of each camera, see :func:`rectify`.
        trajectories: poses T_world_camera of the frames of each camera by its name.
    """

    def __init__(self, log: Log, config: Config, trajectories: Mapping[str, Trajectory]) -> None:
        super().__init__(log)
        self._config, self._trajectories = config, trajectories

    def _decode(self, index: int) -> Frame:
        frame = self._log[index]
        trajectory, config = self._trajectories.get(frame.camera_name), self._config.of_camera(frame.camera_name)
        return frame if trajectory is None else rectify(frame, twist_at(trajectory, frame.stamp), config.sensor)


def twist_at(trajectory: Trajectory, stamp: float) -> Array:
    """Return the twist (6,) [m/s, rad/s] of the camera at a time [s], between the poses before and after it.

    At a pose it is the mean over both of its neighbours. It is zero without poses within
    ``CONSTANTS.max_gap``.
    """
    stamps = trajectory.stamps
    before, after = int(np.searchsorted(stamps, stamp - 1e-6)) - 1, int(np.searchsorted(stamps, stamp + 1e-6, "right"))
    a, b = max(before, 0), min(after, len(stamps) - 1)
    if b <= a or stamps[b] - stamps[a] > CONSTANTS.max_gap:
        return np.zeros(6)
    T_a, T_b = trajectory.T_world_camera[a], trajectory.T_world_camera[b]
    return np.asarray(se3_log(inverse(T_a) @ T_b) / (stamps[b] - stamps[a]))


def moved_pixels(pixels: Array, points: Array, camera: Camera, change: Array, readout: float) -> Array:
    """Return the pixels (N, 2) of points in a rectified image after a change of its twist, to first order.

    Args:
        pixels: (N, 2) in the image rectified with the former twist.
        points: (N, 3) [m] in the camera frame.
        camera: camera of the image.
        change: (6,) difference of the twists (translation [m/s], rotation [rad/s]).
        readout: time from the first row to the last [s].
    """
    s = ((pixels[:, 1] / (camera.height - 1) - 0.5) * readout)[:, None]
    moved = points + s * (change[:3] + np.cross(change[3:], points))
    return np.asarray(pixels + camera.project(moved) - camera.project(points))


def row_displacement(change: Array, depth: float, camera: Camera, readout: float) -> float:
    """Compute the displacement [px] of the first and last row of a rectified image by a change of its twist (6,).

    Args:
        change: (6,) difference of the twists (translation [m/s], rotation [rad/s]).
        depth: typical depth [m].
        camera: camera of the image.
        readout: time from the first row to the last [s].
    """
    angle = float(np.linalg.norm(change[3:])) + float(np.linalg.norm(change[:3])) / depth
    return 0.5 * readout * camera.fx * angle

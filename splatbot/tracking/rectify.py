"""Rectification of frames whose rows are read at different times: the images of one instant, that of the stamp."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot import _native
from splatbot.camera import Camera
from splatbot.config import SensorConfig
from splatbot.frame import Frame

Array = NDArray[np.float64]


def rectify(frame: Frame, twist: Array, sensor: SensorConfig) -> Frame:
    """Return the images that a global shutter takes at the stamp of a frame.

    A point X that a row sees s seconds after the stamp is exp(s ξ) X in the camera at the stamp, for the constant
    twist ξ of the camera (Hedborg et al. 2012). The depth image is resampled first; it defines the displacement of
    colour. A sensor without readout time and delay returns the frame itself.

    Args:
        frame: the frame; its stamp is the time of the middle row of colour.
        twist: (6,) velocity of the camera (translation [m/s], rotation [rad/s]) in its own frame.
        sensor: readout time and delay of depth.
    """
    if (not sensor.readout and not sensor.depth_delay) or not np.any(twist):
        return frame
    camera, velocity = frame.camera, twist.tolist()
    intrinsics = (camera.fx, camera.fy, camera.cx, camera.cy)
    depth = _native.rectify_depth(frame.depth, intrinsics, velocity, sensor.readout, sensor.depth_delay, np.eye(4))
    if not sensor.readout:
        return replace(frame, depth=depth)
    at = np.asarray(_native.rectify_map(depth, intrinsics, velocity, sensor.readout, 0.0))
    rgb = cv2.remap(frame.rgb, at, None, cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    mask = np.ones(frame.depth.shape, np.uint8) if frame.mask is None else frame.mask.astype(np.uint8)
    seen = cv2.remap(mask, at, None, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0) > 0
    return replace(frame, rgb=np.asarray(rgb, np.uint8), depth=np.where(seen, depth, np.float32(0)), mask=seen)


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

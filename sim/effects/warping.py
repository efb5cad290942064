"""Warps of a frame to the view of the same camera a moment earlier or later."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.geometry import Array, inverse, se3_exp, se3_log
from splatbot.trajectory import Trajectory

_KEY_POSES = 33  # exact poses among the lines of an image; at 200 °/s, the others between two are exact to 1e-6 rad
_SURFACE_TOLERANCE = 0.02  # relative difference of depth between neighbouring pixels of one surface


def motion_during(path: Trajectory, stamp: float, seconds: float) -> list[Array]:
    """Return T_now_then (4, 4) of the times ``seconds / 2`` before and after ``stamp`` [s]."""
    now = inverse(pose_at(path, stamp))
    return [now @ pose_at(path, stamp + side * seconds / 2) for side in (-1, 1)]


def motion_of_lines(path: Trajectory, stamp: float, readout: float, lines: int) -> Array:
    """Return T_now_line (lines, 4, 4) of the time of each line, the first one ``readout / 2`` [s] before ``stamp``."""
    now, shares = inverse(pose_at(path, stamp)), np.linspace(-0.5, 0.5, _KEY_POSES)
    keys = np.array([now @ pose_at(path, stamp + share * readout) for share in shares]).reshape(_KEY_POSES, 16)
    at = np.linspace(-0.5, 0.5, lines)
    return np.stack([np.interp(at, shares, column) for column in keys.T], axis=-1).reshape(lines, 4, 4)


def pose_at(path: Trajectory, t: float) -> Array:
    """Interpolate T_world_camera (4, 4) at ``t`` [s] with constant twist between poses; extrapolate beyond the ends."""
    if len(path) == 1:
        return path.T_world_camera[0]
    i = int(np.clip(np.searchsorted(path.stamps, t, "right") - 1, 0, len(path) - 2))
    a, b = path.T_world_camera[i], path.T_world_camera[i + 1]
    share = (t - path.stamps[i]) / (path.stamps[i + 1] - path.stamps[i])
    return np.asarray(a @ se3_exp(share * se3_log(inverse(a) @ b)))


def flow(camera: Camera, depth: NDArray[np.float32], T_now_then: Array) -> NDArray[np.float32]:
    """Compute the displacement (H, W, 2) [px] of each pixel of the view then to the view now.

    Args:
        camera: camera of both views.
        depth: (H, W) [m] of the view then.
        T_now_then: (4, 4), or (H, 4, 4) if each line is seen at another time.
    """
    rays = camera.backproject(np.ones_like(depth))
    elements = np.moveaxis(T_now_then, (-2, -1), (0, 1)).astype(np.float32)[..., None]  # (4, 4, H or none, 1)
    R, t = elements[:3, :3], elements[:3, 3]
    inverse_depth = np.divide(1.0, depth, out=np.zeros_like(depth), where=depth > 0)
    # x/z of R·ray·depth + t, divided by the depth so that infinitely far is a number
    x, y, z = (R[k, 0] * rays[..., 0] + R[k, 1] * rays[..., 1] + R[k, 2] + t[k] * inverse_depth for k in range(3))
    z = np.maximum(z, np.float32(1e-3))  # points behind the camera leave the image
    u = (x / z - rays[..., 0]) * np.float32(camera.fx)
    v = (y / z - rays[..., 1]) * np.float32(camera.fy)
    return np.stack([u, v], axis=-1)


def grid(height: int, width: int) -> NDArray[np.float32]:
    """Return the coordinates (H, W, 2) of each pixel."""
    return np.stack(np.meshgrid(np.arange(width), np.arange(height)), axis=-1).astype(np.float32)


def color_at(rgb: NDArray[np.uint8], at: NDArray[np.float32]) -> NDArray[np.uint8]:
    """Interpolate colours (H, W, 3) at positions (H, W, 2) [px]; outside, the border colour repeats."""
    found = cv2.remap(rgb, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.asarray(found, dtype=np.uint8)


def depth_at(depth: NDArray[np.float32], at: NDArray[np.float32]) -> NDArray[np.float32]:
    """Sample depth (H, W) [m] at (H, W, 2) [px]: linear on one surface, nearest at edges, 0 outside."""
    nearest, linear = (_remapped(depth, at, mode) for mode in (cv2.INTER_NEAREST, cv2.INTER_LINEAR))
    whole = _remapped((depth > 0).astype(np.float32), at, cv2.INTER_LINEAR) > 0.999
    return np.where(whole & (np.abs(linear - nearest) <= _SURFACE_TOLERANCE * nearest), linear, nearest)


def _remapped(image: NDArray[np.float32], at: NDArray[np.float32], mode: int) -> NDArray[np.float32]:
    found = cv2.remap(image, at[..., 0], at[..., 1], mode, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
    return np.asarray(found, dtype=np.float32)

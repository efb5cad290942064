"""Rays of lenses in float64 without OpenCV, and a scene whose images and depths are known in closed form."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.protocols import Array

FISHEYE = Camera(70.0, 71.0, 78.0, 61.0, 160, 120, (0.05, -0.02, 0.01, -0.003), fisheye=True)
"""A lens that sees 130 degrees across its width."""


def pinhole_rays(camera: Camera) -> Array:
    """Return the rays (H, W, 3) of the pixels of a pinhole camera with z = 1."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones_like(u)], -1)


def fisheye_pixels(camera: Camera, points: Array) -> Array:
    """Project points (..., 3) by Kannala and Brandt's polynomial: pixels (..., 2)."""
    radius = np.hypot(points[..., 0], points[..., 1])
    theta = np.arctan2(radius, points[..., 2])
    k1, k2, k3, k4 = camera.distortion
    bent = theta + k1 * theta**3 + k2 * theta**5 + k3 * theta**7 + k4 * theta**9
    share = np.divide(bent, radius, out=np.ones_like(radius), where=radius > 0)
    x, y = share * points[..., 0], share * points[..., 1]
    return np.stack([camera.fx * x + camera.cx, camera.fy * y + camera.cy], -1)


def fisheye_rays(camera: Camera) -> Array:
    """Return the rays (H, W, 3) of the pixels of a fisheye with z = 1, by Newton's method."""
    v, u = np.mgrid[: camera.height, : camera.width].astype(np.float64)
    x, y = (u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy
    radius = np.hypot(x, y)
    theta, powers = radius.copy(), np.arange(1, 10, 2)
    k = np.array([1.0, *camera.distortion])
    for _ in range(30):
        value = (k * theta[..., None] ** powers).sum(-1)
        slope = (k * powers * theta[..., None] ** (powers - 1)).sum(-1)
        theta -= (value - radius) / slope
    share = np.divide(np.tan(theta), radius, out=np.ones_like(radius), where=radius > 0)
    return np.stack([share * x, share * y, np.ones_like(x)], -1)


def shelf(rays: Array, origin: Array | None = None) -> tuple[NDArray[np.uint8], Array, NDArray[np.bool_]]:
    """Trace rays (H, W, 3) with z = 1 to boards at z = 1 m before a wall at z = 2 m.

    Returns:
        Colour (H, W, 3), which changes smoothly with the place on a surface, depth (H, W) [m], and the board's pixels.
    """
    start = np.zeros(3) if origin is None else origin
    at_board = start + rays * (1.0 - start[2])
    board = (np.abs(at_board[..., 0]) % 0.8 < 0.3) & (np.abs(at_board[..., 1]) < 0.7)
    depth = np.where(board, 1.0, 2.0) - start[2]
    x, y = np.moveaxis((start + rays * depth[..., None])[..., :2], -1, 0)
    tint = np.where(board, 160.0, 90.0)
    rgb = np.stack([128 + 60 * np.sin(2 * x), 128 + 60 * np.cos(2 * y), tint], -1)
    return np.rint(rgb).astype(np.uint8), depth, board

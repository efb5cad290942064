"""Small RGB-D frames for the tests of tracking and mapping: walls in closed form and the synthetic tabletop."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.camera import Camera
from splatbot.config import Config
from splatbot.frame import Frame
from splatbot.geometry import inverse
from splatbot.logs import open_log

Array = NDArray[np.float64]

CAMERA = Camera(130.0, 131.0, 79.0, 60.0, 160, 120)


def small_config(**overrides: Any) -> Config:
    """Return the defaults with less of everything, for images of 160x120; a key is ``section__name``."""
    values: dict[str, Any] = {
        "tracking": {"n_pixels": 1200, "n_features": 600},
        "mapping": {"refine_iterations": 2, "final_iterations": 3},
    }
    for key, value in overrides.items():
        section, _, name = key.partition("__")
        values[section] = values.get(section, {}) | {name: value} if name else value
    return Config.model_validate(values)


@cache
def tabletop(frames: int = 12, width: int = 160) -> tuple[tuple[Frame, ...], tuple[Array, ...]]:
    """Return frames of the synthetic tabletop and their exact poses (4, 4) in the frame of the first camera."""
    log = open_log(f"synthetic:tabletop?width={width}&height={width * 3 // 4}&frames={frames}")
    truth = log.ground_truth
    assert truth is not None
    T_first_world = inverse(truth.T_world_camera[0])
    return tuple(log[i] for i in range(frames)), tuple(T_first_world @ T for T in truth.T_world_camera)


def wall_depth(camera: Camera, T_world_camera: Array, normal: ArrayLike, distance: float) -> Array:
    """Compute the exact depth (H, W) [m] of the plane ``normal · x = distance`` in the world frame."""
    n = np.asarray(normal, dtype=np.float64)
    rays = rays_of(camera) @ T_world_camera[:3, :3].T
    depth: Array = (distance - n @ T_world_camera[:3, 3]) / (rays @ n)
    return depth


def wall_frame(
    T_world_camera: Array,
    *,
    normal: ArrayLike = (0.0, 0.0, 1.0),
    distance: float = 1.0,
    textured: bool = True,
    camera: Camera = CAMERA,
    stamp: float = 0.0,
) -> Frame:
    """Render the wall ``normal · x = distance`` with a smooth pattern as a function of its points, or in grey."""
    z = wall_depth(camera, T_world_camera, normal, distance)
    points = (rays_of(camera) * z[..., None]) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    rgb = pattern(points) if textured else np.full(points.shape, 0.6)
    return Frame(stamp, np.rint(255 * rgb).astype(np.uint8), z.astype(np.float32), camera)


def rays_of(camera: Camera) -> Array:
    """Return directions (H, W, 3) with z = 1 through the pixel centres in the camera frame."""
    u, v = np.meshgrid(np.arange(camera.width), np.arange(camera.height))
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], -1)


def pattern(points: Array) -> Array:
    """Return RGB (..., 3) in 0..1 of world points (..., 3) [m]: waves of 9 to 30 cm, which are smooth over 1 cm."""
    x, y, z = np.moveaxis(points, -1, 0)
    waves = np.stack(
        [np.sin(37 * x + 11 * y) + np.sin(23 * y - 5 * z), np.sin(60 * y + 7 * x), np.cos(41 * x - 29 * y)], -1
    )
    return 0.5 + 0.2 * waves / np.array([2.0, 1.0, 1.0])

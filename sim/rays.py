"""Ray casting against the collision geometry of a simulation, without rendering."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.protocols import Array

Pixels = NDArray[np.int64]


def pixel_rays(camera: Camera, rows: Pixels | None = None, columns: Pixels | None = None) -> Array:
    """Return rays (h, w, 3) through the centres of the given rows' and columns' pixels, with unit depth."""
    rows = np.arange(camera.height) if rows is None else rows
    columns = np.arange(camera.width) if columns is None else columns
    v, u = np.meshgrid(rows, columns, indexing="ij")
    return np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(u.shape)], axis=-1)


def cast(model: Any, data: Any, rays: Array, T_world_camera: Array, reach: float) -> tuple[NDArray[np.int32], Array]:
    """Return the first hits of camera rays (h, w, 3) at a pose (4, 4); see :func:`pixel_rays`.

    Returns:
        Indices of the geoms (h, w), -1 without a hit within ``reach`` [m], and depth along the optical axis (h, w)
        [m], 0 without a hit.
    """
    # Rays have unit depth, and MuJoCo reports distances in ray lengths, which are therefore depths.
    world = np.ascontiguousarray(rays.reshape(-1, 3) @ T_world_camera[:3, :3].T)
    geoms, depth = np.full(len(world), -1, np.int32), np.zeros(len(world))
    origin = np.ascontiguousarray(T_world_camera[:3, 3])
    mujoco.mj_multiRay(model, data, origin, world.ravel(), None, 1, -1, geoms, depth, None, len(world), reach)
    hit = (geoms >= 0) & (depth >= 0) & (depth <= reach)
    shape = rays.shape[:2]
    return np.where(hit, geoms, np.int32(-1)).reshape(shape), np.where(hit, depth, 0.0).reshape(shape)

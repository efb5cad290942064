"""Primitives that fit a cluster of surface points, and how well."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from splatbot.protocols import Array

# A hull follows the noise of its points, and has no side that nobody saw: it is taken only where every primitive's
# error is larger than _PLAIN times the hull's, and by more than noise [m].
_PLAIN, _NOISE = 1.3, 3e-3
_FOOT = 0.3  # of a hull's height whose points stand on the floor
_BARE = 0.25  # of its radius that a ball may stick out over its points
_TRIM = 1.0  # [%] of the points that may stick out of a box or cylinder on each side


@dataclass(frozen=True, eq=False)
class Fit:
    """A shape for a cluster that stands on the plane z = 0.

    Args:
        shape: values of a shape of :mod:`splatbot.sim.solids`, in the object's frame.
        at: (3,) where the object's frame is [m].
        error: mean distance of the points from its surface [m].
        worst: the 95th percentile [m].
    """

    shape: dict[str, Any]
    at: Array
    error: float
    worst: float


def fit(points: Array, floor: float) -> Fit:
    """The shape with the least mean error for points (P, 3) [m] that stand on the height ``floor``.

    Tried are an upright box, an upright cylinder, a ball and, where they all fail, the convex hull.
    """
    best = min(primitive_fits(points, floor), key=lambda f: f.error)
    hull = _hull(points, *_heights(points, floor))
    return hull if best.error > _PLAIN * hull.error + _NOISE else best


def primitive_fits(points: Array, floor: float) -> list[Fit]:
    """An upright box, an upright cylinder and a ball for points (P, 3) [m] that stand on the height ``floor``."""
    low, high = _heights(points, floor)
    return [_box(points, low, high), _cylinder(points, low, high), _ball(points)]


def _heights(points: Array, floor: float) -> tuple[float, float]:
    """Bottom and top [m]: what begins a little over the floor stands on it."""
    lowest = float(points[:, 2].min())
    return min(floor, lowest) if floor > lowest - 0.03 else lowest, float(np.percentile(points[:, 2], 100 - _TRIM))


def _box(points: Array, low: float, high: float) -> Fit:
    _, _, degrees = cv2.minAreaRect(points[:, :2].astype(np.float32))
    yaw = float(np.radians(degrees))
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    q = points @ R
    ends = np.percentile(q, [_TRIM, 100 - _TRIM], axis=0)
    ends[:, 2] = low, high
    middle, half = ends.mean(axis=0), np.maximum(np.diff(ends, axis=0)[0] / 2, 1e-3)
    away = np.abs(q - middle) - half
    distance = np.linalg.norm(np.maximum(away, 0), axis=1) + np.minimum(away.max(axis=1), 0)
    return _fit({"kind": "box", "size": (2 * half).tolist(), "rpy": [0.0, 0.0, yaw]}, R @ middle, distance)


def _cylinder(points: Array, low: float, high: float) -> Fit:
    center, radius = _circle(points[:, :2])
    across = np.linalg.norm(points[:, :2] - center, axis=1) - radius
    along = np.abs(points[:, 2] - (low + high) / 2) - (high - low) / 2
    away = np.stack([across, along], axis=1)
    distance = np.linalg.norm(np.maximum(away, 0), axis=1) + np.minimum(away.max(axis=1), 0)
    shape = {"kind": "cylinder", "radius": radius, "height": max(high - low, 2e-3)}
    return _fit(shape, np.array([*center, (low + high) / 2]), distance)


def _circle(points: Array) -> tuple[Array, float]:
    """About the middle of the smallest circle, with nearly all points inside: robust to filled lids."""
    (x, y), _ = cv2.minEnclosingCircle(points.astype(np.float32))
    center = np.array([x, y])
    return center, max(float(np.percentile(np.linalg.norm(points - center, axis=1), 100 - _TRIM)), 1e-3)


def _ball(points: Array) -> Fit:
    """Least squares in |p|² = 2 c·p + (r² - |c|²); infinitely wrong where its top is far over all points.

    A ring that lies flat is on the surface of many balls.
    """
    A = np.c_[2 * points, np.ones(len(points))]
    x = np.linalg.lstsq(A, (points**2).sum(axis=1), rcond=None)[0]
    radius = float(np.sqrt(max(x[3] + x[:3] @ x[:3], 1e-6)))
    shape = {"kind": "sphere", "radius": radius}
    if x[2] + radius > points[:, 2].max() + _BARE * radius:
        return Fit(shape, x[:3], np.inf, np.inf)
    return _fit(shape, x[:3], np.linalg.norm(points - x[:3], axis=1) - radius)


def _hull(points: Array, low: float, high: float) -> Fit:
    """Down to ``low``, as the others are: clusters begin where the table's noise ends, and would fall and tip."""
    import open3d as o3d

    foot = points[points[:, 2] < low + _FOOT * (high - low)] * [1.0, 1.0, 0.0] + [0.0, 0.0, low]
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(np.concatenate([points, foot])))
    mesh, _ = cloud.compute_convex_hull()
    middle = points.mean(axis=0)
    scene = o3d.t.geometry.RaycastingScene()
    scene.add_triangles(o3d.t.geometry.TriangleMesh.from_legacy(mesh))
    distance = scene.compute_distance(o3d.core.Tensor.from_numpy(points.astype(np.float32))).numpy().astype(np.float64)
    corners = np.asarray(mesh.vertices) - middle
    return _fit({"kind": "mesh", "points": corners.tolist()}, middle, distance)


def _fit(shape: dict[str, Any], at: Array, distance: Array) -> Fit:
    away = np.abs(distance)
    return Fit(shape, at, float(away.mean()), float(np.percentile(away, 95)))

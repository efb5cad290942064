"""Fits of primitive shapes to clusters of surface points."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np

from splatbot.protocols import Array
from splatbot.segmentation.rectangle import fit_rectangle


@dataclass(frozen=True)
class FitConstants:
    """Constants of primitive fits."""

    hull_error_ratio: float = 1.3
    """Ratio [1] to a hull's error that every primitive's error must exceed for the hull to be used. A larger one
    prefers primitives."""
    hull_noise: float = 3e-3
    """Noise [m] that is added to that multiple, since a hull follows the noise and lacks unobserved sides."""
    foot_fraction: float = 0.3
    """Lower part [1] of a hull's height whose points are projected to the floor. A larger one widens the foot of
    tapered objects."""
    max_unobserved_cap: float = 0.25
    """Largest height [1] of a ball above its points, as a share of the radius. A larger one fits balls to domes."""
    trim: float = 1.0
    """Share [%] of points outside of a box or cylinder on each side. A larger one shrinks shapes, a smaller one follows
    outliers."""
    max_floor_gap: float = 0.03
    """Largest distance [m] between a cluster and the floor that it stands on. A larger one extends objects that
    hang."""


CONSTANTS = FitConstants()


@dataclass(frozen=True, eq=False)
class Fit:
    """A shape that fits a cluster.

    Args:
        shape: values of a shape of :mod:`splatbot.sim.solids`, in the object's frame.
        at: (3,) origin of the object's frame [m].
        error: mean distance of the points from the surface [m].
        worst: 95th percentile of the distance [m].
    """

    shape: dict[str, Any]
    at: Array
    error: float
    worst: float


def fit(points: Array, floor: float) -> Fit:
    """Fit the shape with the smallest mean error to points (P, 3) [m] of an object on the height ``floor`` [m].

    Candidates are an upright box, an upright cylinder and a ball. If all have a large error, the convex hull is used.
    """
    best = min(primitive_fits(points, floor), key=lambda f: f.error)
    hull = _hull(points, *_heights(points, floor))
    return hull if best.error > CONSTANTS.hull_error_ratio * hull.error + CONSTANTS.hull_noise else best


def primitive_fits(points: Array, floor: float) -> list[Fit]:
    """Fit an upright box, an upright cylinder and a ball to points (P, 3) [m] of an object on the height ``floor``."""
    low, high = _heights(points, floor)
    return [_box(points, low, high), _cylinder(points, low, high), _ball(points)]


def _heights(points: Array, floor: float) -> tuple[float, float]:
    """Return bottom and top [m]; a cluster that begins less than 3 cm above the floor stands on it."""
    lowest = float(points[:, 2].min())
    return min(floor, lowest) if floor > lowest - CONSTANTS.max_floor_gap else lowest, float(
        np.percentile(points[:, 2], 100 - CONSTANTS.trim)
    )


def _box(points: Array, low: float, high: float) -> Fit:
    yaw = fit_rectangle(points[:, :2]).yaw
    c, s = np.cos(yaw), np.sin(yaw)
    R = np.array([[c, -s, 0], [s, c, 0], [0, 0, 1.0]])
    q = points @ R
    ends = np.percentile(q, [CONSTANTS.trim, 100 - CONSTANTS.trim], axis=0)
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
    """Fit a circle to points (P, 2): centre of the minimum enclosing circle, radius of nearly all points.

    Points of a filled lid do not bias it.
    """
    (x, y), _ = cv2.minEnclosingCircle(points.astype(np.float32))
    center = np.array([x, y])
    return center, max(float(np.percentile(np.linalg.norm(points - center, axis=1), 100 - CONSTANTS.trim)), 1e-3)


def _ball(points: Array) -> Fit:
    """Fit a sphere with centre c and radius r by linear least squares: |p|² = 2 c·p + (r² - |c|²).

    The error is infinite if the top of the sphere is far above all points, since a flat ring fits many spheres.
    """
    A = np.c_[2 * points, np.ones(len(points))]
    x = np.linalg.lstsq(A, (points**2).sum(axis=1), rcond=None)[0]
    radius = float(np.sqrt(max(x[3] + x[:3] @ x[:3], 1e-6)))
    shape = {"kind": "sphere", "radius": radius}
    if x[2] + radius > points[:, 2].max() + CONSTANTS.max_unobserved_cap * radius:
        return Fit(shape, x[:3], np.inf, np.inf)
    return _fit(shape, x[:3], np.linalg.norm(points - x[:3], axis=1) - radius)


def _hull(points: Array, low: float, high: float) -> Fit:
    """Compute the convex hull of the points and of their lower part projected to the height ``low``.

    Clusters begin above the noise of the table. Without the projection a simulated hull would fall and tip over.
    """
    import open3d as o3d

    foot = points[points[:, 2] < low + CONSTANTS.foot_fraction * (high - low)] * [1.0, 1.0, 0.0] + [0.0, 0.0, low]
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

"""Visibility of Gaussians in depth images: the depth at a Gaussian's pixel confirms it or lies behind it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, transform_points
from splatbot.protocols import Array


@dataclass(frozen=True)
class VisibilityConstants:
    """Constants of the depth test.

    Args:
        depth_tolerance: [m] difference from the Gaussian's depth that hits it at any distance; a larger one passes it.
        depth_tolerance_per_z2: [1/m] growth of the tolerance with z² (Khoshelham, Elberink 2012: sigma = 1.4e-3 z²).
    """

    depth_tolerance: float = 0.01
    depth_tolerance_per_z2: float = 0.006


CONSTANTS = VisibilityConstants()


DepthView = tuple[NDArray[np.float32], Camera, Array]  # depth (H, W) [m], 0 or NaN if invalid, camera, T_world_camera


@dataclass(frozen=True, eq=False)
class VisibilityEvidence:
    """Counts over depth images, at the pixel to which the mean of each Gaussian projects.

    Args:
        hits: (N,) int32, number of images whose depth equals that of the Gaussian.
        passes: (N,) int32, number of images whose depth lies behind the Gaussian, so that the ray passed it.
    """

    hits: NDArray[np.int32]
    passes: NDArray[np.int32]

    @property
    def seen_through(self) -> NDArray[np.bool_]:
        """True (N,) where passes outnumber hits; rays do not pass a real surface."""
        return self.passes > self.hits

    def select(self, rows: NDArray[np.int64]) -> VisibilityEvidence:
        """Return the counts of some rows."""
        return VisibilityEvidence(self.hits[rows], self.passes[rows])


def gather_evidence(model: GaussianModel, views: Iterable[DepthView]) -> VisibilityEvidence:
    """Count hits and passes of a model's Gaussians over views.

    Args:
        model: the map.
        views: depth (H, W) [m], 0 or NaN where invalid, camera, and T_world_camera (4, 4) of each view.

    Raises:
        InputError: the size of a depth image differs from its camera's.
    """
    return evidence_at(model.means.detach().numpy().astype(np.float64), views)


def evidence_at(points: Array, views: Iterable[DepthView]) -> VisibilityEvidence:
    """Count hits and passes of points (P, 3) [m, world]; see :func:`gather_evidence`.

    Raises:
        InputError: the size of a depth image differs from its camera's.
    """
    hits, passes = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    for depth, camera, T_world_camera in views:
        if depth.shape != (camera.height, camera.width):
            raise InputError(f"is {depth.shape}.", field="depth", hint=f"give ({camera.height}, {camera.width})")
        rows, measured, z = measured_depths(points, depth, camera, T_world_camera)
        tolerance = passing_distance(z)
        hits[rows[np.abs(measured - z) <= tolerance]] += 1
        passes[rows[measured - z > tolerance]] += 1
    return VisibilityEvidence(hits, passes)


def passing_distance(z: Array) -> Array:
    """Return how far behind depths z (P,) [m] a measured depth must lie so that its ray passed them [m]."""
    return np.asarray(CONSTANTS.depth_tolerance + CONSTANTS.depth_tolerance_per_z2 * z**2)


def measured_depths(
    points: Array, depth: NDArray[np.float32], camera: Camera, T_world_camera: Array
) -> tuple[NDArray[np.int64], Array, Array]:
    """Return the points that project to a pixel with depth: rows (M,), measured depth (M,), own depth (M,) [m]."""
    p = transform_points(inverse(T_world_camera), points)
    rows = np.flatnonzero(p[:, 2] > 0.05)
    u = np.rint(camera.fx * p[rows, 0] / p[rows, 2] + camera.cx)
    v = np.rint(camera.fy * p[rows, 1] / p[rows, 2] + camera.cy)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    rows, u, v = rows[inside], u[inside].astype(np.int64), v[inside].astype(np.int64)
    measured = depth[v, u].astype(np.float64)
    there = np.isfinite(measured) & (measured > 0)
    return rows[there], measured[there], p[rows[there], 2]

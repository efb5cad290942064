"""What depth images say of each Gaussian: a surface was measured there, or something behind it was."""

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

# A depth within this much of a Gaussian's own hits it; one farther behind sees through it. It grows with the square of
# the depth, as a structured-light camera's noise does (Khoshelham & Elberink 2012: sigma = 1.4e-3 z^2).
TOLERANCE, TOLERANCE_PER_Z2 = 0.01, 0.006  # [m], [1/m]

DepthView = tuple[NDArray[np.float32], Camera, Array]  # depth (H, W) [m, 0: none], its camera, T_world_camera (4, 4)


@dataclass(frozen=True, eq=False)
class VisibilityEvidence:
    """Counts (N,) over depth images, by the pixel on which each Gaussian's mean falls.

    Args:
        hits: how often the depth there was the Gaussian's own.
        passes: how often it was behind it, so that the ray went through.
    """

    hits: NDArray[np.int32]
    passes: NDArray[np.int32]

    @property
    def seen_through(self) -> NDArray[np.bool_]:
        """More often than hit: no ray would pass through a surface."""
        return self.passes > self.hits

    def select(self, rows: NDArray[np.int64]) -> VisibilityEvidence:
        """The counts of some rows."""
        return VisibilityEvidence(self.hits[rows], self.passes[rows])


def gather_evidence(model: GaussianModel, views: Iterable[DepthView]) -> VisibilityEvidence:
    """Count over views, each a depth image (H, W) [m, 0 or NaN: none], its camera and T_world_camera (4, 4).

    Raises:
        InputError: a depth image is not of its camera's size.
    """
    return evidence_at(model.means.detach().numpy().astype(np.float64), views)


def evidence_at(points: Array, views: Iterable[DepthView]) -> VisibilityEvidence:
    """The same of points (P, 3) [m, world].

    Raises:
        InputError: a depth image is not of its camera's size.
    """
    hits, passes = np.zeros(len(points), np.int32), np.zeros(len(points), np.int32)
    for depth, camera, T_world_camera in views:
        if depth.shape != (camera.height, camera.width):
            raise InputError(f"is {depth.shape}.", field="depth", hint=f"give ({camera.height}, {camera.width})")
        rows, measured, z = measured_depths(points, depth, camera, T_world_camera)
        tolerance = TOLERANCE + TOLERANCE_PER_Z2 * z**2
        hits[rows[np.abs(measured - z) <= tolerance]] += 1
        passes[rows[measured - z > tolerance]] += 1
    return VisibilityEvidence(hits, passes)


def measured_depths(
    points: Array, depth: NDArray[np.float32], camera: Camera, T_world_camera: Array
) -> tuple[NDArray[np.int64], Array, Array]:
    """The points that fall on a pixel with depth: their rows (M,), the depth there (M,), and their own (M,) [m]."""
    p = transform_points(inverse(T_world_camera), points)
    rows = np.flatnonzero(p[:, 2] > 0.05)
    u = np.rint(camera.fx * p[rows, 0] / p[rows, 2] + camera.cx)
    v = np.rint(camera.fy * p[rows, 1] / p[rows, 2] + camera.cy)
    inside = (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    rows, u, v = rows[inside], u[inside].astype(np.int64), v[inside].astype(np.int64)
    measured = depth[v, u].astype(np.float64)
    there = np.isfinite(measured) & (measured > 0)
    return rows[there], measured[there], p[rows[there], 2]

"""Gaussians merged to few ellipsoids: fine within the arm's reach, coarser beyond."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.geometry import quat_to_rotation, rotation_to_quat
from splatbot.protocols import Array


@dataclass(frozen=True)
class EllipsoidConstants:
    """Constants of collision ellipsoids of a map."""

    reach: float = 0.9
    """Distance [m] from the base within which cells have the smallest size: the reach of an arm of this size."""
    tangent_sigmas: float = 2.2
    """Half-axis [σ] in the surface. A smaller one leaves gaps between ellipsoids, through which objects fall."""
    normal_sigmas: float = 1.0
    """Half-axis [σ] across the surface. A larger one lifts objects that rest on it."""
    min_axis: float = 1e-3
    """Shortest half-axis [m]. Cells whose Gaussians lie in a plane have none of their own."""
    min_cell: float = 0.005
    """Smallest size [m] of a cell. A smaller one gives finer shapes as far as the limit of their number permits."""
    growth: float = 1.15
    """Ratio [1] between tried cell sizes. A smaller one comes closer to the limit, in more passes."""


CONSTANTS = EllipsoidConstants()


@dataclass(frozen=True, eq=False)
class Ellipsoids:
    """E ellipsoids.

    Args:
        centers: (E, 3) [m].
        axes: (E, 3) half-axes [m].
        quats: (E, 4) wxyz.
        error: mean distance of the Gaussians' centres from the surface of their ellipsoid [m].
        worst: the 95th percentile [m].
    """

    centers: Array
    axes: Array
    quats: Array
    error: float
    worst: float


def merge(means: Array, covariances: Array, weights: Array, base: Array, limit: int) -> Ellipsoids:
    """Merge Gaussians to at most ``limit`` ellipsoids, with the mean and covariance of those in each cell.

    Cells have one size within 0.9 m of ``base`` and grow with the distance beyond.

    Args:
        means: (N, 3) [m].
        covariances: (N, 3, 3) [m²].
        weights: (N,).
        base: (3,) of the robot [m].
        limit: maximum number.
    """
    empty = np.zeros((0, 3))
    if limit == 0 or not len(means):
        return Ellipsoids(empty, empty, np.zeros((0, 4)), 0.0, 0.0)
    size = CONSTANTS.min_cell
    while True:
        cell = _cells(means, base, size)
        if int(cell.max()) < limit:
            break
        size *= CONSTANTS.growth
    count = int(cell.max()) + 1
    total = np.bincount(cell, weights, count)
    centers = np.stack([np.bincount(cell, weights * means[:, k], count) / total for k in range(3)], axis=1)
    away = means - centers[cell]
    spread = covariances + away[:, :, None] * away[:, None, :]
    merged = np.stack(
        [np.bincount(cell, weights * spread[:, i, j], count) / total for i in range(3) for j in range(3)], 1
    )
    values, R = np.linalg.eigh(merged.reshape(-1, 3, 3))
    R[np.linalg.det(R) < 0, :, 0] *= -1
    axes = np.sqrt(np.maximum(values, 0)) * [
        CONSTANTS.normal_sigmas,
        CONSTANTS.tangent_sigmas,
        CONSTANTS.tangent_sigmas,
    ]
    axes = np.maximum(axes, CONSTANTS.min_axis)
    distance = np.abs(_distance(np.einsum("nij,ni->nj", R[cell], away), axes[cell]))
    return Ellipsoids(
        centers, axes, rotation_to_quat(R), float(distance.mean()), float(np.percentile(distance, 95))
    )  # fmt: skip


def surface_points(ellipsoids: Ellipsoids) -> Array:
    """Sample points (E, 14, 3) on the surfaces [m]: the ends of the axes, and the centres of the octants."""
    corners = np.stack(np.meshgrid(*3 * [[-1.0, 1.0]], indexing="ij"), axis=-1).reshape(-1, 3) / np.sqrt(3)
    directions = np.concatenate([np.eye(3), -np.eye(3), corners])
    local = ellipsoids.axes[:, None] * directions
    return np.asarray(
        ellipsoids.centers[:, None] + np.einsum("eij,epj->epi", quat_to_rotation(ellipsoids.quats), local)
    )


def _cells(means: Array, base: Array, size: float) -> np.ndarray:
    """Assign a cell number to each Gaussian; cells double in size in shells beyond the reach."""
    beyond = np.maximum(np.linalg.norm(means - base, axis=1) - CONSTANTS.reach, 0.0)
    shell = np.minimum(np.ceil(np.log2(1.0 + beyond / (0.5 * CONSTANTS.reach))), 6).astype(np.int64)
    index = np.floor(means / (size * 2.0**shell)[:, None]).astype(np.int64)
    return np.asarray(np.unique(np.c_[shell, index], axis=0, return_inverse=True)[1]).ravel()


def _distance(p: Array, axes: Array) -> Array:
    """Approximate the signed distance of points to axis-aligned ellipsoids to first order (Quilez): k0 (k0 - 1) / k1.

    Inside, the distance is limited to that along the shortest axis.
    """
    k0 = np.linalg.norm(p / axes, axis=1)
    k1 = np.maximum(np.linalg.norm(p / axes**2, axis=1), 1e-12)
    return np.maximum(k0 * (k0 - 1.0) / k1, -axes.min(axis=1) * np.sqrt(np.maximum(1.0 - k0**2, 0.0)))

"""Support planes: RANSAC with a least-squares refinement."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.protocols import Array

NEAR = 0.01  # [m] maximum distance of an inlier from the plane


@dataclass(frozen=True)
class SupportConstants:
    """Constants of support detection.

    Args:
        iterations: number of iterations of RANSAC.
        max_ransac_sample: maximum number of points on which RANSAC counts inliers.
        min_up_cosine: minimum cosine between the normal of a support and up.
        min_inlier_fraction: minimum fraction of the points that are inliers.
    """

    iterations: int = 300
    max_ransac_sample: int = 5000
    min_up_cosine: float = float(np.cos(np.radians(15.0)))
    min_inlier_fraction: float = 0.05


CONSTANTS = SupportConstants()


@dataclass(frozen=True, eq=False)
class Support:
    """A support plane: points p with normal · p = offset.

    Args:
        normal: (3,) upward unit normal.
        offset: [m].
        error: RMS distance of the inliers [m].
        inside: (P,) inlier mask.
    """

    normal: Array
    offset: float
    error: float
    inside: NDArray[np.bool_]

    def height(self, points: Array) -> Array:
        """Return the heights (P,) [m] of points (P, 3) above the plane."""
        return np.asarray(points @ self.normal - self.offset)


def given_support(points: Array, normal: Array, offset: float) -> Support:
    """Return a known plane normal · p = offset with its inliers among points (P, 3) [m]."""
    away = points @ normal - offset
    inside = np.abs(away) < NEAR
    return Support(normal, offset, float(np.sqrt(np.mean(away[inside] ** 2))) if inside.any() else 0.0, inside)


def find_support(points: Array, *, seed: int = 0) -> Support | None:
    """Find the horizontal plane with the most inliers among points (P, 3) [m, z up].

    RANSAC (Fischler and Bolles 1981) draws three points a, b, c and scores their plane by its inliers::

        n = (b - a) x (c - a) / |(b - a) x (c - a)|,   d = n · a,   inliers: |n · p - d| < 1 cm

    Three rounds of least squares then refit the best plane: n is the right singular vector of the smallest singular
    value of the centred inliers. The result is deterministic for a seed. Without a plane that has 5 % of the points as
    inliers, the function returns None.
    """
    if len(points) < 20:
        return None
    rng = np.random.default_rng(seed)
    sample = points[rng.choice(len(points), min(len(points), CONSTANTS.max_ransac_sample), replace=False)]
    best, most = None, 0
    for _ in range(CONSTANTS.iterations):
        a, b, c = sample[rng.choice(len(sample), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-9 or abs(normal[2]) < CONSTANTS.min_up_cosine * length:
            continue
        normal = normal / length * np.sign(normal[2])
        count = int((np.abs(sample @ normal - a @ normal) < NEAR).sum())
        if count > most:
            best, most = (normal, float(a @ normal)), count
    if best is None or most < CONSTANTS.min_inlier_fraction * len(sample):
        return None
    return _refined(points, *best)


def _refined(points: Array, normal: Array, offset: float) -> Support:
    for _ in range(3):
        near = points[np.abs(points @ normal - offset) < NEAR]
        middle = near.mean(axis=0)
        normal = np.linalg.svd(near - middle, full_matrices=False)[2][2]
        normal = normal * np.sign(normal[2])
        offset = float(middle @ normal)
    return given_support(points, normal, offset)

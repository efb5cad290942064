"""The plane that things stand on."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.protocols import Array

NEAR = 0.01  # [m] that points of the plane are off by at most
_TRIES = 300
_TILT = np.cos(np.radians(15.0))  # a support is level
_SHARE = 0.05  # of all points that a plane must have


@dataclass(frozen=True, eq=False)
class Support:
    """Points p with normal · p = offset.

    Args:
        normal: (3,) unit, upwards.
        offset: [m].
        error: RMS distance of its points [m].
        inside: (P,) which points are on it.
    """

    normal: Array
    offset: float
    error: float
    inside: NDArray[np.bool_]

    def height(self, points: Array) -> Array:
        """Of points (P, 3) above it (P,) [m]."""
        return np.asarray(points @ self.normal - self.offset)


def given_support(points: Array, normal: Array, offset: float) -> Support:
    """A plane normal · p = offset that is known, with those of the points (P, 3) [m] that are on it."""
    away = points @ normal - offset
    inside = np.abs(away) < NEAR
    return Support(normal, offset, float(np.sqrt(np.mean(away[inside] ** 2))) if inside.any() else 0.0, inside)


def find_support(points: Array, *, seed: int = 0) -> Support | None:
    """The level plane with most of the points (P, 3) [m, z up]; None if none has 5 % of them.

    RANSAC (Fischler and Bolles 1981), then least squares on the points of the best. Repeatable.
    """
    if len(points) < 20:
        return None
    rng = np.random.default_rng(seed)
    sample = points[rng.choice(len(points), min(len(points), 5000), replace=False)]
    best, most = None, 0
    for _ in range(_TRIES):
        a, b, c = sample[rng.choice(len(sample), 3, replace=False)]
        normal = np.cross(b - a, c - a)
        length = float(np.linalg.norm(normal))
        if length < 1e-9 or abs(normal[2]) < _TILT * length:
            continue
        normal = normal / length * np.sign(normal[2])
        count = int((np.abs(sample @ normal - a @ normal) < NEAR).sum())
        if count > most:
            best, most = (normal, float(a @ normal)), count
    if best is None or most < _SHARE * len(sample):
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

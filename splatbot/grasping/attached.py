"""Attached objects: spheres that cover a held object, so that motion planning includes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.errors import InputError
from splatbot.protocols import Array


@dataclass(frozen=True)
class AttachedConstants:
    """Constants of the spheres of an attached object.

    Args:
        finest_cell: [m] smallest cell size that is tried.
        coarsening: factor on the cell size until the number of spheres fits.
    """

    finest_cell: float = 0.01
    coarsening: float = 1.25


CONSTANTS = AttachedConstants()


def covering_spheres(points: Array, reach: Array, *, max_spheres: int = 100) -> Array:
    """Cover balls around points by at most ``max_spheres`` spheres (A, 4), (x, y, z, radius) [m].

    Points are grouped by the cubes of a grid, which is coarsened until there are few enough cubes. Each sphere is
    centred on the bounding box of the points in its cube.

    Args:
        points: (P, 3) surface points of the object [m].
        reach: (P,) radius of the ball around each point [m].
        max_spheres: maximum number of spheres.

    Raises:
        InputError: there are no points, or ``max_spheres`` is not above 0.
    """
    if not len(points) or max_spheres < 1:
        raise InputError("has no points, or max_spheres is below 1.", field="object", hint="name another target")
    size = CONSTANTS.finest_cell
    while True:
        cells = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
        _, group = np.unique(cells, axis=0, return_inverse=True)
        group = group.reshape(-1)
        count = int(group.max()) + 1
        if count <= max_spheres:
            break
        size *= CONSTANTS.coarsening
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, group, points)
    np.maximum.at(high, group, points)
    center = (low + high) / 2
    radius = np.zeros(count)
    np.maximum.at(radius, group, np.linalg.norm(points - center[group], axis=1) + reach)
    return np.c_[center, radius]

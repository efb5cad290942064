"""A held object as spheres of the arm's last link, as planning takes it along."""

from __future__ import annotations

import numpy as np

from splatbot.errors import InputError
from splatbot.protocols import Array

_FINEST = 0.01  # [m] between spheres
_COARSER = 1.25


def covering_spheres(points: Array, reach: Array, *, most: int = 100) -> Array:
    """At most so many spheres (A, 4), (x, y, z, radius) [m], that cover balls around points.

    Points are gathered in cubes of a grid, which is made coarser until there are few enough; each sphere is around the
    middle of its points' box.

    Args:
        points: (P, 3) on the surface of the object [m].
        reach: (P,) radius of the ball around each [m].
        most: spheres.

    Raises:
        InputError: there are no points, or ``most`` is not above 0.
    """
    if not len(points) or most < 1:
        raise InputError("has no points, or no spheres are wanted.", field="object", hint="name another target")
    size = _FINEST
    while True:
        cells = np.floor((points - points.min(axis=0)) / size).astype(np.int64)
        _, group = np.unique(cells, axis=0, return_inverse=True)
        group = group.reshape(-1)
        count = int(group.max()) + 1
        if count <= most:
            break
        size *= _COARSER
    low, high = np.full((count, 3), np.inf), np.full((count, 3), -np.inf)
    np.minimum.at(low, group, points)
    np.maximum.at(high, group, points)
    center = (low + high) / 2
    radius = np.zeros(count)
    np.maximum.at(radius, group, np.linalg.norm(points - center[group], axis=1) + reach)
    return np.c_[center, radius]

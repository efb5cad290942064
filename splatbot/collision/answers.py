"""What the collision field answers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class MahalanobisResult:
    """Answers for P points.

    Args:
        distance: (P,) float32, in standard deviations of the nearest Gaussian; infinity where the map is empty.
        index: (P,) int64, that Gaussian's row in the model (the lowest of equals), -1 where the map is empty.
        map_version: the state of the map that was asked.
    """

    distance: NDArray[np.float32]
    index: NDArray[np.int64]
    map_version: int


@dataclass(frozen=True, eq=False)
class ClearanceResult:
    """Euclidean answers for P points or spheres; an array of ``distance`` to numpy.

    Args:
        distance: (P,) [m], the signed distance from the sphere's surface to the nearest n-sigma ellipsoid: never more
            than the true one, and less by at most 4e-6 (|v|₁ + a) + 1e-6 A, with v [m] from the ellipsoid's centre to
            the point in its frame, a and A its least and longest semi-axes. Negative inside.
            Infinity: nothing within the cut.
        gradient: (P, 3), of the distance with respect to the point: the unit normal of that ellipsoid. 0 for no answer.
        witness: (P, 3) [m, world], the nearest point of that ellipsoid's surface. NaN for no answer.
        index: (P,) int64, that Gaussian's row in the model, -1 for none.
        map_version: the state of the map that was asked.
    """

    distance: NDArray[np.float64]
    gradient: NDArray[np.float64]
    witness: NDArray[np.float64]
    index: NDArray[np.int64]
    map_version: int

    def __array__(self, dtype: type | None = None, copy: bool | None = None) -> NDArray[np.float64]:
        return np.array(self.distance, dtype=dtype)


@dataclass(frozen=True)
class NeighboursResult:
    """The k nearest Gaussians of P points or spheres, nearest first.

    Args:
        distance: (P, k) [m], as in :class:`ClearanceResult`; infinity where there are fewer.
        index: (P, k) int64, rows of the model; -1 where there are fewer.
        map_version: the state of the map that was asked.
    """

    distance: NDArray[np.float64]
    index: NDArray[np.int64]
    map_version: int

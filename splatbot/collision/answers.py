"""Results of the queries of a collision field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray


@dataclass(frozen=True)
class MahalanobisResult:
    """Mahalanobis distances of P points.

    Args:
        distance: (P,) float32, in standard deviations of the nearest Gaussian; infinity if the map is empty.
        index: (P,) int64, row of that Gaussian in the model, the lowest of equals; -1 if the map is empty.
        map_version: version of the map.
    """

    distance: NDArray[np.float32]
    index: NDArray[np.int64]
    map_version: int


@dataclass(frozen=True, eq=False)
class ClearanceResult:
    """Clearance of P points or spheres; numpy converts it to the array ``distance``.

    The distance d bounds the true signed distance D from below, with the error::

        0 <= D - d <= 4e-6 (|v|₁ + a) + 1e-6 A

    Here v [m] leads from the centre of the ellipsoid to the point, in the frame of the ellipsoid. Its shortest and
    longest semi-axes are a and A [m].

    Args:
        distance: (P,) signed distance from the surface of the sphere to the nearest n-sigma ellipsoid [m]; negative
            inside, infinity if no ellipsoid is within the cut.
        gradient: (P, 3) derivative of the distance with respect to the point, which is the unit normal of the
            ellipsoid; 0 if no ellipsoid is within the cut.
        witness: (P, 3) nearest point of the surface of the ellipsoid [m, world]; NaN if none is within the cut.
        index: (P,) int64, row of that Gaussian in the model; -1 if none is within the cut.
        map_version: version of the map.
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
    """The k nearest Gaussians of P points or spheres, sorted by distance.

    Args:
        distance: (P, k) signed distances as in :class:`ClearanceResult` [m]; infinity beyond the last Gaussian.
        index: (P, k) int64, rows of the model; -1 beyond the last Gaussian.
        map_version: version of the map.
    """

    distance: NDArray[np.float64]
    index: NDArray[np.int64]
    map_version: int

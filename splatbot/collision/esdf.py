"""Euclidean signed distance field (ESDF) on a dense grid, sampled from a collision field."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.collision.field import GaussianCollisionField
from splatbot.collision.inputs import rows
from splatbot.errors import InputError
from splatbot.protocols import Array

MAX_ESDF_VOXELS = 20_000_000


@dataclass(frozen=True, eq=False)
class Esdf:
    """Euclidean signed distances at the centres of voxels.

    Args:
        distance: (X, Y, Z) float32, see :meth:`GaussianCollisionField.clearance`, at most the cut [m].
        gradient: (X, Y, Z, 3) float32 derivative with respect to the point; 0 beyond the cut.
        origin: (3,) corner of the first voxel [m, world].
        voxel: edge length [m].
        map_version: version of the map.
    """

    distance: NDArray[np.float32]
    gradient: NDArray[np.float32]
    origin: Array
    voxel: float
    map_version: int

    def centers(self) -> Array:
        """Return the centres (X, Y, Z, 3) of the voxels [m, world]."""
        return np.moveaxis(np.indices(self.distance.shape), 0, -1) * self.voxel + self.origin + self.voxel / 2


def esdf(field: GaussianCollisionField, aabb: ArrayLike, voxel: float, *, cut: float = 1.0) -> Esdf:
    """Sample distance and gradient at the centres of the voxels of a box.

    Args:
        field: collision field.
        aabb: (2, 3) = (low, high), corners of the box [m, world].
        voxel: edge length [m].
        cut: largest distance [m].

    Raises:
        InputError: the box is empty, the voxel or cut is not above 0, or there are more than 20 million voxels.
    """
    low, high = rows(np.asarray(aabb, dtype=np.float64), "aabb", 3, "corners in metres")[:2]
    if not (voxel > 0 and cut > 0 and (high > low).all()):
        raise InputError(
            f"is {low.tolist()}..{high.tolist()} in {voxel} m.", field="aabb", hint="give low < high, voxel > 0"
        )
    size = np.ceil((high - low) / voxel - 1e-9).astype(np.int64)
    if np.prod(size.astype(float)) > MAX_ESDF_VOXELS:
        raise InputError(f"needs {size.tolist()} voxels.", field="voxel", hint=f"at most {MAX_ESDF_VOXELS} in all")
    centers = np.moveaxis(np.indices(tuple(size.tolist())), 0, -1).reshape(-1, 3) * voxel + low + voxel / 2
    sampled = field.clearance(centers, cut=cut)
    return Esdf(
        np.minimum(sampled.distance, cut).astype(np.float32).reshape(*size),
        sampled.gradient.astype(np.float32).reshape(*size, 3),
        low,
        float(voxel),
        field.map_version,
    )

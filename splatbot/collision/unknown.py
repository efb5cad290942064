"""Unknown space, which no depth image has observed; the caller treats it as free, as occupied or as a cost."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.camera import Camera
from splatbot.collision.inputs import rows
from splatbot.collision.visibility import measured_depths
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.protocols import Array


@dataclass(frozen=True, eq=False)
class UnknownSpace:
    """Voxels of a box that no depth ray has passed.

    A caller ignores this class to treat unknown space as free. To treat it as occupied, append :meth:`solids` to the
    map (``GaussianModel.concatenate``) before the field is built. To treat it as a cost, query a separate field of
    :meth:`solids`.

    Args:
        unknown: (X, Y, Z), True where unknown.
        origin: (3,) corner of the first voxel [m, world].
        voxel: edge length [m].
    """

    unknown: NDArray[np.bool_]
    origin: Array
    voxel: float

    def at(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Return whether points (P, 3) [m, world] lie in unknown space; space outside the box is unknown."""
        p = rows(np.asarray(points), "points", 3, "world coordinates in metres")
        cell = np.floor((p - self.origin) / self.voxel).astype(np.int64)
        inside = ((cell >= 0) & (cell < self.unknown.shape)).all(axis=1)
        found = np.ones(len(p), np.bool_)
        found[inside] = self.unknown[tuple(cell[inside].T)]
        return found

    def solids(self, n_sigma: float = 2.0, *, rim: bool = True) -> GaussianModel:
        """Return spheres that enclose the unknown voxels, as Gaussians whose surface is at ``n_sigma``.

        With ``rim`` only voxels with a known neighbour are returned. A motion that starts in known space cannot reach
        the interior without passing the rim.
        """
        known = np.pad(~self.unknown, 1, constant_values=False)
        has_known_neighbour = np.zeros_like(self.unknown)
        for shift in np.ndindex(3, 3, 3):
            i, j, k = shift
            x, y, z = self.unknown.shape
            has_known_neighbour |= known[i : i + x, j : j + y, k : k + z]
        cells = np.argwhere(self.unknown & has_known_neighbour if rim else self.unknown)
        n = len(cells)
        return GaussianModel.from_activated(
            means=self.origin + (cells + 0.5) * self.voxel,
            quats=np.tile([1.0, 0, 0, 0], (n, 1)),
            scales=np.full((n, 3), np.sqrt(3) / 2 * self.voxel / n_sigma),
            opacities=np.full(n, 0.99),
            colors=np.full((n, 3), 0.5),
        )


def find_unknown(
    aabb: ArrayLike, voxel: float, views: Iterable[tuple[NDArray[np.float32], Camera, Array]]
) -> UnknownSpace:
    """Find the voxels of a box that no measured ray is known to have passed.

    A voxel is free if the depth at the pixel of its centre lies behind the whole voxel. A voxel that rays cross only
    away from its centre stays unknown, which is conservative.

    Args:
        aabb: (2, 3) = (low, high), corners of the box [m, world].
        voxel: edge length [m].
        views: depth (H, W) [m], 0 or NaN where invalid, camera, and T_world_camera (4, 4) of each view.

    Raises:
        InputError: the box is empty, or the voxel is not above 0.
    """
    low, high = rows(np.asarray(aabb, dtype=np.float64), "aabb", 3, "corners in metres")[:2]
    if not (voxel > 0 and (high > low).all()):
        raise InputError(
            f"is {low.tolist()}..{high.tolist()} in {voxel} m.", field="aabb", hint="give low < high, voxel > 0"
        )
    size = np.ceil((high - low) / voxel - 1e-9).astype(np.int64)
    centers = np.moveaxis(np.indices(tuple(size.tolist())), 0, -1).reshape(-1, 3) * voxel + low + voxel / 2
    unknown = np.ones(len(centers), np.bool_)
    for depth, camera, T_world_camera in views:
        left = np.flatnonzero(unknown)
        hit, measured, z = measured_depths(centers[left], depth, camera, T_world_camera)
        unknown[left[hit[measured > z + np.sqrt(3) / 2 * voxel]]] = False
    return UnknownSpace(unknown.reshape(*size), low, float(voxel))

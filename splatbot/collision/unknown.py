"""Space that no depth image has seen: free, occupied, or at a cost; the caller says which."""

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
    """Which voxels of a box were never seen to be free.

    Unknown as *free*: do not ask. As *occupied*: join :meth:`solids` to the map (``GaussianModel.concatenate``) before
    making a field. As a *cost*: make a field of :meth:`solids` alone, and ask it beside the map's.

    Args:
        unknown: (X, Y, Z).
        origin: (3,) [m, world], the first voxel's corner.
        voxel: edge [m].
    """

    unknown: NDArray[np.bool_]
    origin: Array
    voxel: float

    def at(self, points: ArrayLike) -> NDArray[np.bool_]:
        """Whether points (P, 3) [m, world] lie in unknown space; outside of the box everything is unknown."""
        p = rows(np.asarray(points), "points", 3, "world coordinates in metres")
        cell = np.floor((p - self.origin) / self.voxel).astype(np.int64)
        inside = ((cell >= 0) & (cell < self.unknown.shape)).all(axis=1)
        found = np.ones(len(p), np.bool_)
        found[inside] = self.unknown[tuple(cell[inside].T)]
        return found

    def solids(self, n_sigma: float = 2.0, *, rim: bool = True) -> GaussianModel:
        """A ball around each unknown voxel, as Gaussians of ``n_sigma``; with ``rim``, of those with a known neighbour.

        Balls hold the whole voxel. What starts in known space cannot reach the inside without passing the rim.
        """
        known = np.pad(~self.unknown, 1, constant_values=False)
        beside = np.zeros_like(self.unknown)
        for shift in np.ndindex(3, 3, 3):
            i, j, k = shift
            x, y, z = self.unknown.shape
            beside |= known[i : i + x, j : j + y, k : k + z]
        cells = np.argwhere(self.unknown & beside if rim else self.unknown)
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
    """The voxels of a box (2, 3) = (low, high) [m] through which no measured ray is known to have passed.

    A voxel is known to be free where the depth at the pixel of its centre is behind the voxel's far side; those that
    are crossed only off their centre stay unknown, which is safe.

    Args:
        aabb: corners of the box.
        voxel: edge [m].
        views: depth (H, W) [m, 0 or NaN: none], camera and T_world_camera (4, 4) of each.

    Raises:
        InputError: the box is empty or the voxel not above 0.
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

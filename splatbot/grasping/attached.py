"""Attached objects: spheres that cover a held object, so that motion planning includes it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.grasping.surface import GraspSurface
from splatbot.protocols import Array


@dataclass(frozen=True)
class AttachedConstants:
    """Constants of the spheres of an attached object.

    Args:
        max_spheres: largest number of spheres. Fewer are larger, and reach farther beyond the object.
        max_arm_spheres: the same with the spheres of an arm, that collision checks take (kMostSpheres in
            arm_kernels.hpp).
        finest_cell: [m] smallest cell size that is tried.
        coarsening: factor on the cell size until the number of spheres fits.
        sigmas: standard deviations to which the Gaussians of an attached object are inflated.
        enclosed_sides: axis directions of six in which the object must surround a stray Gaussian; a cup is open in one.
    """

    max_spheres: int = 300
    max_arm_spheres: int = 640
    finest_cell: float = 0.01
    coarsening: float = 1.25
    sigmas: float = 1.0
    enclosed_sides: int = 5


CONSTANTS = AttachedConstants()


def covering_spheres(points: Array, reach: Array, *, max_spheres: int = CONSTANTS.max_spheres) -> Array:
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


def object_spheres(surface: GraspSurface, *, max_spheres: int = CONSTANTS.max_spheres) -> Array:
    """Cover a surface, completed on its unobserved sides, by spheres (A, 4) (x, y, z, radius) [m, world].

    Each surface point is inflated by its sampling radius where it was completed, and by its standard deviation along
    the normal.
    """
    reach = np.where(surface.observed, 0.0, surface.spread) + CONSTANTS.sigmas * surface.normal_std
    return covering_spheres(surface.points, reach, max_spheres=max_spheres)


def within(points: Array, spheres: Array) -> NDArray[np.bool_]:
    """Return which points (P, 3) are strays inside of an object that spheres (A, 4) cover.

    A point is inside if a sphere contains it, or if spheres lie in at least five of the six axis directions from it.
    """
    low, high = (spheres[:, :3] - spheres[:, 3:]).min(axis=0), (spheres[:, :3] + spheres[:, 3:]).max(axis=0)
    found = np.zeros(len(points), np.bool_)
    rows = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    between = spheres[None, :, :3] - points[rows, None]
    sides = np.zeros(len(rows), np.int64)
    for k in range(3):
        aligned = np.linalg.norm(np.delete(between, k, axis=2), axis=2) < spheres[:, 3]
        sides += (aligned & (between[..., k] > 0)).any(axis=1)
        sides += (aligned & (between[..., k] < 0)).any(axis=1)
    found[rows] = (sides >= CONSTANTS.enclosed_sides) | (np.linalg.norm(between, axis=2) <= spheres[:, 3]).any(axis=1)
    return found

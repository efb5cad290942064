"""Volume and centre of mass of a surface of oriented points, by generalized winding numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.grasping.surface import CONSTANTS as SURFACE
from splatbot.protocols import Array


@dataclass(frozen=True)
class VolumeConstants:
    """Constants of the enclosed volume.

    Args:
        max_volume_points: maximum number of surface points; more are subsampled.
        max_cells: maximum number of grid cells over the bounding box.
        inside_winding: winding number above which a point is inside.
        min_cells: number of inside cells below which the surface encloses no volume.
        same_side_cosine: minimum cosine between normals on the same side of a thin object.
    """

    max_volume_points: int = 800
    max_cells: int = 3000
    inside_winding: float = 0.5
    min_cells: int = 30
    same_side_cosine: float = 0.3


CONSTANTS = VolumeConstants()


def winding_numbers(places: Array, points: Array, normals: Array, areas: Array, *, softened: float) -> Array:
    """Compute the generalized winding numbers (P,) of oriented points at the queries ``places`` (P, 3).

    Following Barill et al. 2018, with points p_i, unit normals n_i and areas A_i::

        w(q) = sum_i A_i (p_i - q) · n_i / (4 pi |p_i - q|³)

    It is 1 inside of a closed surface and 0 outside; holes lead to values in between.

    Args:
        places: (P, 3) query points [m].
        points: (M, 3) surface points [m].
        normals: (M, 3) outward unit normals.
        areas: (M,) area of each point [m²].
        softened: distance [m] to which smaller distances are clipped, which bounds the singularity.
    """
    middle = points.mean(axis=0)
    p, q = (places - middle).astype(np.float32), (points - middle).astype(np.float32)
    dipole = (normals * areas[:, None] / (4 * np.pi)).astype(np.float32)
    own, square = np.einsum("ij,ij->i", dipole, q), (q**2).sum(axis=1)
    found = np.zeros(len(p))
    for k in range(0, len(p), 256):
        a = p[k : k + 256]
        away = np.maximum((a**2).sum(axis=1)[:, None] - 2 * (a @ q.T) + square, softened**2)
        found[k : k + 256] = ((own - a @ dipole.T) / (away * np.sqrt(away))).sum(axis=1)
    return found


@dataclass(frozen=True, eq=False)
class Volume:
    """Volume that a surface encloses.

    Args:
        center: (3,) centroid [m]; the centre of mass for a uniform density.
        size: volume [m³].
    """

    center: Array
    size: float


def enclosed_volume(points: Array, normals: Array, *, seed: int = 0) -> Volume:
    """Compute the enclosed volume by the winding numbers of a grid over the bounding box.

    Points that enclose no volume, such as a single face, yield the centre of their box and the volume 0.

    Args:
        points: (M, 3) surface points [m].
        normals: (M, 3) outward unit normals.
        seed: seed of the subsampling of more than 800 points.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    none = Volume((low + high) / 2, 0.0)
    if len(points) > CONSTANTS.max_volume_points:
        chosen = np.sort(np.random.default_rng(seed).choice(len(points), CONSTANTS.max_volume_points, replace=False))
        points, normals = points[chosen], normals[chosen]
    size = float((np.prod(high - low) / CONSTANTS.max_cells) ** (1 / 3))
    if not size > 0.0:
        return none
    axes = (np.arange(a + size / 2, b, size) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    around = winding_numbers(grid, points, normals, _areas(points, normals), softened=size)
    inside = grid[around > CONSTANTS.inside_winding]
    return Volume(inside.mean(axis=0), len(inside) * size**3) if len(inside) >= CONSTANTS.min_cells else none


def _areas(points: Array, normals: Array) -> Array:
    """Estimate the area of each point (M,) [m²] from the kernel density of the points on its side."""
    p, n = (points - points.mean(axis=0)).astype(np.float32), normals.astype(np.float32)
    square = (p**2).sum(axis=1)
    weight = np.exp(np.maximum(square[:, None] + square - 2 * (p @ p.T), 0.0) * (-0.5 / SURFACE.smoothing**2))
    weight *= n @ n.T > CONSTANTS.same_side_cosine
    return np.asarray(2 * np.pi * SURFACE.smoothing**2 / weight.sum(axis=1), dtype=np.float64)

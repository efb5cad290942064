"""What a surface of oriented points encloses: winding numbers, and with them its volume and where its middle is."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.protocols import Array

MOST = 800  # points that a volume is told by
_CELLS = 3000  # of the grid that is filled, at most
_INSIDE = 0.5  # winding number, from where on a place is within
_LEAST = 30  # cells that are a volume
_SMOOTH = 0.006  # [m] over which the density of points is looked at
_SAME = 0.3  # cosine between normals of one side


def winding_numbers(places: Array, points: Array, normals: Array, areas: Array, *, softened: float) -> Array:
    """How far places (P, 3) are surrounded by oriented points (M, 3) that stand for ``areas`` (M,) [m²] (P,).

    Barill et al. 2018: 1 within a closed surface, 0 outside of it, and between for one that has holes.

    Args:
        places: [m].
        points, normals: of the surface [m], unit outwards.
        areas: see there.
        softened: distance below which a point pulls no more [m].
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
    """What a surface encloses.

    Args:
        center: (3,) its middle [m], of a thing of one material its centre of mass.
        size: [m³].
    """

    center: Array
    size: float


def enclosed_volume(points: Array, normals: Array, *, seed: int = 0) -> Volume:
    """Of oriented points (M, 3): a grid over their box is filled by winding numbers.

    Points that enclose nothing, as a single face, have the middle of their box, and no volume.

    Args:
        points, normals: on the surface [m], unit outwards.
        seed: of which points are kept where there are more than 800.
    """
    low, high = points.min(axis=0), points.max(axis=0)
    none = Volume((low + high) / 2, 0.0)
    if len(points) > MOST:
        chosen = np.sort(np.random.default_rng(seed).choice(len(points), MOST, replace=False))
        points, normals = points[chosen], normals[chosen]
    size = float((np.prod(high - low) / _CELLS) ** (1 / 3))
    if not size > 0.0:
        return none
    axes = (np.arange(a + size / 2, b, size) for a, b in zip(low, high, strict=True))
    grid = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1).reshape(-1, 3)
    around = winding_numbers(grid, points, normals, _areas(points, normals), softened=size)
    inside = grid[around > _INSIDE]
    return Volume(inside.mean(axis=0), len(inside) * size**3) if len(inside) >= _LEAST else none


def _areas(points: Array, normals: Array) -> Array:
    """That each point stands for (M,) [m²], by how dense its side is there."""
    p, n = (points - points.mean(axis=0)).astype(np.float32), normals.astype(np.float32)
    square = (p**2).sum(axis=1)
    weight = np.exp(np.maximum(square[:, None] + square - 2 * (p @ p.T), 0.0) * (-0.5 / _SMOOTH**2))
    weight *= n @ n.T > _SAME
    return np.asarray(2 * np.pi * _SMOOTH**2 / weight.sum(axis=1), dtype=np.float64)

"""Proofs that spheres contain triangles, and how far the spheres reach beyond them.

A piece of a triangle whose corners lie in one sphere lies in it, because a sphere is convex. Other pieces are halved
across their longest edge. So a proof holds for every point of a mesh, not for sampled ones.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.protocols import Array, LinkSpheres
from splatbot.robots.shapes import Shape, depth_of, distance_of


@dataclass(frozen=True)
class ContainmentConstants:
    """Constants of proofs.

    Args:
        size: [m] longest edge of a piece that is not halved; it bounds the error of an uncovered distance.
        chunk: pieces that are tested at once; it bounds memory.
        directions: points on each sphere from which the slack is measured.
    """

    size: float = 5e-4
    chunk: int = 20_000
    directions: int = 500


CONSTANTS = ContainmentConstants()


def open_pieces(triangles: Array, centers: Array, radii: Array, size: float = CONSTANTS.size) -> Array:
    """Return the pieces (P, 3, 3) of triangles (T, 3, 3) that lie in no single sphere, with edges up to ``size`` [m].

    Args:
        triangles: (T, 3, 3) corners [m].
        centers: (S, 3) of the spheres [m].
        radii: (S,) [m].
        size: longest edge of a piece that is not halved [m].
    """
    left: list[Array] = []
    waiting = [triangles]
    while waiting:
        some = waiting.pop()
        for k in range(0, len(some), CONSTANTS.chunk):
            pieces = some[k : k + CONSTANTS.chunk]
            corners, rows = np.unique(pieces.reshape(-1, 3), axis=0, return_inverse=True)
            inside = np.stack([np.linalg.norm(corners - c, axis=1) <= r for c, r in zip(centers, radii, strict=True)])
            pieces = pieces[~inside[:, rows.reshape(-1, 3)].all(axis=2).any(axis=0)]
            edges = np.linalg.norm(pieces - np.roll(pieces, -1, axis=1), axis=2)
            small = edges.max(axis=1) <= size
            left.append(pieces[small])
            if not small.all():
                waiting.append(_halves(pieces[~small], edges[~small]))
    return np.concatenate(left) if left else np.zeros((0, 3, 3))


def beyond(pieces: Array, centers: Array, radii: Array) -> Array:
    """Compute the distance (P, S) [m] by which the farthest corner of each piece is outside of each sphere."""
    if not len(centers):
        return np.full((len(pieces), 1), np.inf)
    # |a - c|² = |a|² + |c|² - 2 a·c would lose digits; differences are exact enough for a proof to a nanometre.
    far = np.zeros((len(pieces), len(centers)))
    for k in range(3):
        np.maximum(far, np.linalg.norm(pieces[:, k, None] - centers, axis=2), out=far)
    return far - radii


def lacking(pieces: Array, centers: Array, radii: Array) -> tuple[Array, NDArray[np.int64]]:
    """Compute by how much (P,) [m] the best sphere of each piece has to grow, and the row of that sphere (P,)."""
    found = [
        (missing.min(axis=1), missing.argmin(axis=1))
        for k in range(0, len(pieces), CONSTANTS.chunk)
        for missing in (beyond(pieces[k : k + CONSTANTS.chunk], centers, radii),)
    ]
    if not found:
        return np.zeros(0), np.zeros(0, np.int64)
    return np.concatenate([least for least, _ in found]), np.concatenate([row for _, row in found])


def _halves(pieces: Array, edges: Array) -> Array:
    """Halve triangles (P, 3, 3) across their longest edge."""
    rows, first = np.arange(len(pieces)), edges.argmax(axis=1)
    a, b, c = (pieces[rows, (first + k) % 3] for k in range(3))
    middle = (a + b) / 2
    return np.concatenate([np.stack([a, middle, c], axis=1), np.stack([middle, b, c], axis=1)])


def uncovered(shapes: Sequence[Shape], spheres: LinkSpheres, size: float = CONSTANTS.size) -> float:
    """Return an upper bound of the distance [m] from the spheres to the farthest surface point of the shapes.

    0 or less is a proof that every point is inside. The bound exceeds the distance by at most ``size`` [m].
    """
    return max(uncovered_by_link(shapes, spheres, size).values(), default=-np.inf)


def uncovered_by_link(shapes: Sequence[Shape], spheres: LinkSpheres, size: float = CONSTANTS.size) -> dict[int, float]:
    """Return the bound of :func:`uncovered` for each link that has shapes."""
    found: dict[int, float] = {}
    for shape in shapes:
        own = spheres.link == shape.link
        centers, radii = spheres.centers[own], spheres.radii[own] + NANOMETRE
        left = open_pieces(shape.triangles(), centers, radii, size)
        worst = float(lacking(left, centers, radii)[0].max(initial=0.0))
        found[shape.link] = max(found.get(shape.link, 0.0), worst)
    return found


NANOMETRE = 1e-9  # [m] rounding error of corners and radii in float64, a thousandth of the arm's ARM_ROUNDING


@dataclass(frozen=True)
class Slack:
    """Distances [m] of the outer surface of spheres from the shapes that they cover, weighted by area.

    Args:
        median: of half of the area.
        most99: of 99 % of the area.
        largest: of all.
    """

    median: float
    most99: float
    largest: float


def slack_of(shapes: Sequence[Shape], centers: Array, radii: Array) -> Slack:
    """Measure the slack of the spheres of one link.

    Args:
        shapes: of the link; points in a closed shape are not on the outer surface.
        centers: (S, 3) [m, link frame].
        radii: (S,) [m].
    """
    points, weights = outer_surface(centers, radii)
    outside = depth_of(shapes, points) < 0
    points, weights = points[outside], weights[outside]
    distance = distance_of(shapes, points)
    order = np.argsort(distance)
    share = np.cumsum(weights[order]) / weights.sum()
    median, most99 = (float(distance[order][min(int(np.searchsorted(share, f)), len(order) - 1)]) for f in (0.5, 0.99))
    return Slack(median, most99, float(distance.max()))


def outer_surface(centers: Array, radii: Array) -> tuple[Array, NDArray[np.float64]]:
    """Return points (P, 3) [m] of the surface of a union of spheres, and the area (P,) [m²] of each."""
    u = _fibonacci(CONSTANTS.directions)
    found, weights = [], []
    for i, (center, radius) in enumerate(zip(centers, radii, strict=True)):
        points = center + radius * u
        away = np.linalg.norm(points[:, None] - centers, axis=2) - radii
        away[:, i] = np.inf
        points = points[away.min(axis=1) > 0]
        found.append(points)
        weights.append(np.full(len(points), 4 * np.pi * radius**2 / len(u)))
    return np.concatenate(found), np.concatenate(weights)


def _fibonacci(count: int) -> Array:
    """Return unit vectors (count, 3), evenly spread on a sphere."""
    k = np.arange(count) + 0.5
    z, turn = 1 - 2 * k / count, np.pi * (1 + 5**0.5) * k
    ring = np.sqrt(1 - z * z)
    return np.stack([ring * np.cos(turn), ring * np.sin(turn), z], axis=1)

"""Spheres that cover the collision geometry of links, and a check of the cover."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatbot.errors import InputError
from splatbot.protocols import Array, LinkSpheres
from splatbot.robots.shapes import Box, Capsule, Mesh, Shape


def cover(shapes: Sequence[Shape], slack: float) -> LinkSpheres:
    """Cover every shape with spheres that extend at most ``slack`` [m] beyond it.

    The spheres of a capsule of radius R have the radius r = R + slack. Their distance along the segment is at most
    2 sqrt(r² - R²), so that their union contains the capsule. For boxes and meshes see :func:`cover_solid`.
    """
    found = [(shape.link, *cover_shape(shape, slack)) for shape in shapes]
    link = np.concatenate([np.full(len(radii), link, np.int32) for link, _, radii in found])
    order = np.argsort(link, kind="stable")
    centers = np.concatenate([c for _, c, _ in found])
    radii = np.concatenate([r for _, _, r in found])
    return LinkSpheres(link[order], np.ascontiguousarray(centers[order]), radii[order])


def cover_shape(shape: Shape, slack: float) -> tuple[Array, Array]:
    """Return the centres (S, 3) [m, link frame] and radii (S,) [m] of the spheres of one shape."""
    if not slack > 0:
        raise InputError(f"is {slack}.", field="slack", hint="give metres above 0, as 0.01")
    if isinstance(shape, Capsule):
        return _cover_capsule(shape, slack)
    if isinstance(shape, (Box, Mesh)):
        return cover_solid(shape, slack)
    raise InputError(
        f"cannot be covered: {type(shape).__name__}.", field="shape", hint="give capsules, boxes or meshes"
    )


def _cover_capsule(shape: Capsule, slack: float) -> tuple[Array, Array]:
    """Place spheres a chord apart; the outer ones lie a slack inside the ends and contain the tips of the caps."""
    radius = shape.radius + slack
    half_chord = np.sqrt(radius**2 - shape.radius**2)
    middle = (np.asarray(shape.start) + np.asarray(shape.end)) / 2
    inner = shape.length - 2 * slack
    if inner <= 0:
        return middle[None], np.array([shape.radius + shape.length / 2])
    count = int(np.ceil(inner / (2 * half_chord))) + 1
    at = np.linspace(-inner / 2, inner / 2, count)
    return middle + at[:, None] * shape.along(), np.full(count, radius)


def cover_solid(shape: Box | Mesh, slack: float) -> tuple[Array, Array]:
    """Cover a solid greedily: the candidate that covers most uncovered surface points is next.

    Candidates are the inscribed spheres at the points of a grid, enlarged by the slack. Spheres of radius ``slack`` on
    the surface cover the remaining points. A surface point represents a neighbourhood of a quarter of the slack, which
    follows from the sampling. Every radius is reduced by this amount in the test.
    """
    spacing = slack / 8
    left = _thinned(shape.surface(spacing), spacing / 2)
    grid = _grid(left.min(axis=0), left.max(axis=0), slack)
    depth = shape.depth(grid)
    centers, radii = grid[depth > 0], depth[depth > 0] + slack
    found: list[tuple[Array, float]] = []
    few = left[:: max(1, len(left) // 3000)]
    covers = np.stack(
        [np.linalg.norm(few - c, axis=1) <= r - 2 * spacing for c, r in zip(centers, radii, strict=True)]
        or [np.zeros(len(few), bool)]
    )
    while (gains := covers.sum(axis=1)).max() > 0:
        best = int(gains.argmax())
        found.append((centers[best], float(radii[best])))
        covers &= ~covers[best]
    for center, radius in found:
        left = left[np.linalg.norm(left - center, axis=1) > radius - 2 * spacing]
    while len(left):
        found.append((left[0], slack))
        left = left[np.linalg.norm(left - left[0], axis=1) > slack - 2 * spacing]
    return np.array([center for center, _ in found]), np.array([radius for _, radius in found])


def _thinned(points: Array, cell: float) -> Array:
    """Keep the first point of each cell [m] of a grid."""
    at = np.floor((points - points.min(axis=0)) / cell).astype(np.int64)
    size = at.max(axis=0) + 1
    _, first = np.unique((at[:, 0] * size[1] + at[:, 1]) * size[2] + at[:, 2], return_index=True)
    return points[np.sort(first)]


def _grid(low: Array, high: Array, slack: float) -> Array:
    """Return grid points (P, 3) with a step of the slack, or a sixteenth of the longest side if that is larger."""
    step = max(slack, float((high - low).max()) / 16)
    lines = [np.linspace(low[k], high[k], int((high[k] - low[k]) / step) + 3)[1:-1] for k in range(3)]
    return np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)


def uncovered(shapes: Sequence[Shape], spheres: LinkSpheres, spacing: float) -> float:
    """Return the largest distance [m] of a surface point of the shapes from the spheres.

    The sampling makes it too small by at most ``spacing`` [m]. A negative value is the smallest depth of any point in
    the spheres.
    """
    worst = -np.inf
    for shape in shapes:
        own = spheres.link == shape.link
        points = shape.surface(spacing)
        distance = np.full(len(points), np.inf)
        for center, radius in zip(spheres.centers[own], spheres.radii[own], strict=True):
            distance = np.minimum(distance, np.linalg.norm(points - center, axis=1) - radius)
        worst = max(worst, float(distance.max()))
    return worst

"""Spheres that contain the geometry of links: fitted to points of its surface, then grown until the proof succeeds."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.protocols import Array, LinkSpheres
from splatbot.robots.containment import NANOMETRE, lacking, open_pieces
from splatbot.robots.shapes import Capsule, Mesh, Shape, depth_of, winding_number


@dataclass(frozen=True)
class SphereFitConstants:
    """Constants of the fit of spheres.

    Args:
        points: points of the surface that the selected spheres must contain; more are added where the proof fails.
        candidates: spheres to select from, a third of them in the volume and the others below the surface.
        deepest: [m] largest depth of a candidate that is placed below the surface, at least.
        deepest_of_slack: the same relative to the slack.
        rounds: selections at most.
        size: [m] edge of the pieces in the proof, but a quarter of a small slack. Every selected sphere contains its
            points with this margin.
        size_of_slack: the edge relative to the slack, which bounds the pieces of large arms.
        growth: [m] growth of a radius that ends the selection, at least.
        growth_of_slack: the same relative to the slack.
        added: points that are added in a round, at most.
        apart: [m] distance between added points, at least.
        apart_of_slack: the same relative to the slack.
        nodes: of the branch-and-bound tree of a selection, at most. The greedy selection is taken if it is smaller.
        seconds: [s] time limit of a selection, above the usual time, so that the spheres do not depend on the load of
            the machine.
        gap: relative gap to the fewest spheres at which a selection ends.
        seed: of the samples.
    """

    points: int = 600
    candidates: int = 3000
    deepest: float = 0.05
    deepest_of_slack: float = 4.0
    rounds: int = 3
    size: float = 1e-3
    size_of_slack: float = 0.05
    growth: float = 1e-3
    growth_of_slack: float = 0.05
    added: int = 150
    apart: float = 4e-3
    apart_of_slack: float = 0.3
    nodes: int = 10
    seconds: float = 20.0
    gap: float = 0.1
    seed: int = 0


_MOST_ANGLES = 1_000_000  # solid angles that are computed at once
QUICK = SphereFitConstants()  # of robots that users add: seconds a link
FINE = SphereFitConstants(
    points=1200, candidates=6000, rounds=5, nodes=1_000_000, gap=0.04
)  # of shipped bodies: minutes


def cover(shapes: Sequence[Shape], slack: float, fit: SphereFitConstants = QUICK) -> LinkSpheres:
    """Cover the shapes of each link with spheres that extend about ``slack`` [m] beyond them.

    The spheres of a capsule of radius R have the radius r = R + slack. Their distance along the segment is at most
    2 sqrt(r² - R²), so that their union contains the capsule. For boxes and meshes see :func:`cover_solids`.

    Raises:
        InputError: the slack is not above 0.
    """
    if not slack > 0:
        raise InputError(f"is {slack}.", field="slack", hint="give metres above 0, as 0.01")
    found: list[tuple[int, Array, Array]] = []
    for link in sorted({shape.link for shape in shapes}):
        own = [shape for shape in shapes if shape.link == link]
        found += [(link, *_cover_capsule(shape, slack)) for shape in own if isinstance(shape, Capsule)]
        if solids := [shape for shape in own if not isinstance(shape, Capsule)]:
            found.append((link, *cover_solids(solids, slack, fit)))
    return LinkSpheres(
        np.concatenate([np.full(len(radii), link, np.int32) for link, _, radii in found]),
        np.concatenate([centers for _, centers, _ in found]),
        np.concatenate([radii for _, _, radii in found]),
    )


def _cover_capsule(shape: Capsule, slack: float) -> tuple[Array, Array]:
    """Place spheres a chord apart; the outer ones lie inside the ends and contain the tips of the caps.

    They contain the mesh of the capsule too, whose corners lie outside by 2 % of its radius.
    """
    outer = 1.02 * shape.radius
    radius = max(shape.radius + slack, outer + slack / 2)
    half_chord = np.sqrt(radius**2 - outer**2)
    middle = (np.asarray(shape.start) + np.asarray(shape.end)) / 2
    inner = shape.length - 2 * (radius - outer)
    if inner <= 0:
        return middle[None], np.array([outer + shape.length / 2])
    count = int(np.ceil(inner / (2 * half_chord))) + 1
    at = np.linspace(-inner / 2, inner / 2, count)
    return middle + at[:, None] * shape.along(), np.full(count, radius)


def cover_solids(shapes: Sequence[Shape], slack: float, fit: SphereFitConstants = QUICK) -> tuple[Array, Array]:
    """Cover boxes and meshes of one link by the fewest spheres found, and prove that they contain every triangle.

    Candidates are spheres inscribed in a closed shape and enlarged by ``slack``, and spheres of radius ``slack`` on the
    surface. A minimum set cover of surface points selects from them (integer programming by HiGHS). Where the proof
    fails, points are added. Finally radii grow by at most ``fit.growth``, and small spheres are added, to contain the
    pieces that are left; see :func:`splatbot.robots.containment.open_pieces`. Candidates are smaller by the growth, so
    that no sphere extends farther than ``slack`` beyond the shapes.

    Returns:
        centres (S, 3) [m, link frame] and radii (S,) [m].
    """
    fit = replace(
        fit,
        size=proof_size(slack, fit),
        deepest=max(fit.deepest, fit.deepest_of_slack * slack),
        growth=max(fit.growth, fit.growth_of_slack * slack),
        apart=max(fit.apart, fit.apart_of_slack * slack),
    )
    rng = np.random.default_rng(fit.seed)
    growth = min(fit.growth, slack / 4)
    inner = slack - growth
    triangles = np.concatenate([shape.triangles() for shape in shapes])
    centers, radii = _candidates(shapes, triangles, inner, fit, rng)
    points = np.concatenate([_sampled(triangles, fit.points, rng)[0], *_corners(shapes, fit)])
    for turn in range(fit.rounds):
        missed = ~_contains(centers, radii, points, fit).any(axis=0)
        centers = np.concatenate([centers, points[missed]])
        radii = np.concatenate([radii, np.full(missed.sum(), inner)])
        chosen = _fewest(_contains(centers, radii, points, fit), fit)
        left = open_pieces(triangles, centers[chosen], radii[chosen], fit.size * (2 if turn == 0 else 1))
        if not len(left):
            break
        missing, _ = lacking(left, centers[chosen], radii[chosen])
        if missing.max() <= growth:
            break
        points = np.concatenate([points, _spread(left.mean(axis=1), missing, fit)])
    return _completed(triangles, centers[chosen], radii[chosen], inner, growth, fit)


def proof_size(slack: float, fit: SphereFitConstants = QUICK) -> float:
    """Return the edge [m] of the pieces in the proof of spheres with a slack [m]."""
    return max(min(fit.size, slack / 4), fit.size_of_slack * slack)


def _candidates(
    shapes: Sequence[Shape], triangles: Array, slack: float, fit: SphereFitConstants, rng: np.random.Generator
) -> tuple[Array, Array]:
    """Return spheres (C, 3), (C,) that extend at most the slack beyond the shapes."""
    low, high = triangles.min(axis=(0, 1)), triangles.max(axis=(0, 1))
    anywhere = rng.uniform(low, high, (fit.candidates, 3))
    at, normals = _sampled(triangles, fit.candidates // 3, rng)
    below = at - rng.uniform(slack / 4, fit.deepest, (len(at), 1)) * normals
    towards = at + rng.uniform(0.05, 0.6, (len(at), 1)) * ((low + high) / 2 - at)
    inner = np.concatenate([anywhere, below, towards])
    depth = depth_of(shapes, inner)
    inner, depth = inner[depth > 0], depth[depth > 0]
    inside = _is_inside(shapes, inner)
    inner, depth = inner[inside], depth[inside]
    on, _ = _sampled(triangles, fit.candidates // 30, rng)
    return np.concatenate([inner, on]), np.concatenate([depth, np.zeros(len(on))]) + slack


def _is_inside(shapes: Sequence[Shape], points: Array) -> NDArray[np.bool_]:
    """Return which points (P, 3) lie in a shape; the winding number decides for meshes (Jacobson et al. 2013, eq. 5).

    Rays count faces, and err where a mesh has cracks or faces inside. Outside, the number is about 0. Its sign is the
    orientation of the faces, which some files have inwards.
    """
    found = np.zeros(len(points), dtype=bool)
    for shape in shapes:
        if not isinstance(shape, Mesh):
            found |= shape.depth(points) > 0
        elif shape.closed:
            triangles = shape.triangles()
            step = max(1, _MOST_ANGLES // len(triangles))
            for k in range(0, len(points), step):
                found[k : k + step] |= np.abs(winding_number(triangles, points[k : k + step])) > 0.5
    return found


def _sampled(triangles: Array, count: int, rng: np.random.Generator) -> tuple[Array, Array]:
    """Sample points (count, 3) uniformly on triangles, and their normals."""
    normals = np.cross(triangles[:, 1] - triangles[:, 0], triangles[:, 2] - triangles[:, 0])
    area = np.linalg.norm(normals, axis=1)
    rows = rng.choice(len(triangles), count, p=area / area.sum())
    u, v = rng.random((2, count))
    u, v = np.where(u + v > 1, 1 - u, u)[:, None], np.where(u + v > 1, 1 - v, v)[:, None]
    a, b, c = (triangles[rows, k] for k in range(3))
    return a + u * (b - a) + v * (c - a), normals[rows] / area[rows, None]


def _corners(shapes: Sequence[Shape], fit: SphereFitConstants) -> list[Array]:
    """Return the corners of shapes of few triangles; they are the hardest points to contain."""
    meshes = [shape.triangles() for shape in shapes]
    return [np.unique(t.reshape(-1, 3), axis=0) for t in meshes if len(t) <= fit.points // 2]


def _contains(centers: Array, radii: Array, points: Array, fit: SphereFitConstants) -> NDArray[np.bool_]:
    """Return which spheres contain which points with a margin, (C, P)."""
    return np.stack([np.linalg.norm(points - c, axis=1) <= r - fit.size for c, r in zip(centers, radii, strict=True)])


def _fewest(contains: NDArray[np.bool_], fit: SphereFitConstants) -> NDArray[np.int64]:
    """Select few rows of (C, P) that contain every column."""
    from scipy.optimize import Bounds, LinearConstraint, milp
    from scipy.sparse import csr_matrix

    greedy = _greedy(contains)
    _, columns = np.unique(np.packbits(contains, axis=0), axis=1, return_index=True)
    matrix = csr_matrix(contains[:, columns].T.astype(np.float64))
    answer = milp(
        np.ones(len(contains)),
        constraints=LinearConstraint(matrix, 1, np.inf),
        integrality=np.ones(len(contains)),
        bounds=Bounds(0, 1),
        options={"node_limit": fit.nodes, "time_limit": fit.seconds, "mip_rel_gap": fit.gap},
    )
    if answer.x is None:
        return greedy
    chosen = np.flatnonzero(answer.x > 0.5)
    good = len(chosen) < len(greedy) and bool(contains[chosen].any(axis=0).all())
    return chosen if good else greedy


def _greedy(contains: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Take the row that contains most of the columns that are left, then drop rows that others make superfluous."""
    left, chosen = contains.copy(), []
    while (gains := left.sum(axis=1)).max() > 0:
        best = int(gains.argmax())
        chosen.append(best)
        left[:, left[best].copy()] = False
    times = contains[chosen].sum(axis=0)
    for row in sorted(chosen, key=lambda r: int(contains[r].sum())):
        if (times[contains[row]] > 1).all():
            times -= contains[row]
            chosen.remove(row)
    return np.array(chosen, dtype=np.int64)


def _spread(points: Array, missing: Array, fit: SphereFitConstants) -> Array:
    """Return the points that lack most, apart from each other."""
    found = np.zeros((0, 3))
    for point in points[np.argsort(-missing)][: 40 * fit.added]:
        if len(found) < fit.added and (np.linalg.norm(found - point, axis=1) > fit.apart).all():
            found = np.concatenate([found, point[None]])
    return found


def _completed(
    triangles: Array, centers: Array, radii: Array, inner: float, growth: float, fit: SphereFitConstants
) -> tuple[Array, Array]:
    """Cover the pieces that are left: by spheres of radius ``inner`` on those that lack more than ``growth``.

    Other pieces make the sphere grow that needs to grow least.
    """
    left = open_pieces(triangles, centers, radii, fit.size)
    missing, nearest = lacking(left, centers, radii)
    while len(missing) and missing.max() > growth:
        middle = left[int(missing.argmax())].mean(axis=0)
        by_new = lacking(left, middle[None], np.array([inner]))[0]
        nearest[by_new < missing] = len(centers)
        np.minimum(missing, by_new, out=missing)
        centers, radii = np.concatenate([centers, middle[None]]), np.append(radii, inner)
    grown = radii.copy()
    np.maximum.at(grown, nearest, radii[nearest] + missing + NANOMETRE)
    return centers, grown

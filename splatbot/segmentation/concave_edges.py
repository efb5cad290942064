"""Segmentation of large connected structures, such as a shelf with objects at its walls, at concave edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.protocols import Array
from splatbot.segmentation.clusters import clusters
from splatbot.segmentation.faces import local_normals, nearest_of


@dataclass(frozen=True)
class ConcaveEdgeConstants:
    """Constants of the segmentation at concave edges."""

    plane_candidates: int = 150
    """Number of points [1] whose tangent planes are scored. Fewer of them miss small faces, more of them take
    proportionally longer."""
    max_inlier_sample: int = 4000
    """Largest number of points [1] on which inliers are counted. It bounds the time for large clusters; fewer points
    make the choice between planes of similar size random."""
    max_planes: int = 16
    """Largest number of planes [1]. It bounds the time for clusters of many faces."""
    min_plane_fraction: float = 0.01
    """Smallest share [1] of the points that are inliers of a plane. A smaller one splits curved surfaces."""
    inlier_distance: float = 0.008
    """Largest distance [m] of an inlier from its plane. A larger one merges parallel faces, a smaller one splits noisy
    ones."""
    inlier_cosine: float = 0.8
    """Smallest cosine [1] between the normal at a point and that of its plane."""
    max_concave_offset: float = 0.006
    """Largest distance [m] by which faces of one object lie in front of each other. A larger one merges objects that
    touch."""
    min_contact_points: int = 5
    """Smallest number of points [1] of a face near another face that it meets. A larger one separates faces that share
    only a short edge."""


CONSTANTS = ConcaveEdgeConstants()


@dataclass(frozen=True, eq=False)
class _PlanarFace:
    """A connected face in a plane normal · p = offset; the normal points to the observing cameras."""

    rows: NDArray[np.int64]
    normal: Array
    offset: float

    def offset_of(self, points: Array) -> float:
        """Return the median signed distance of points (P, 3) in front of the face [m]."""
        return float(np.median(points @ self.normal) - self.offset)


def split_at_concave_edges(points: Array, observers: Array, *, apart: float, fewest: int) -> list[NDArray[np.int64]]:
    """Split connected points into parts of faces that meet at convex edges; return the rows of each, largest first.

    Objects are locally convex towards the camera (Stein et al. 2014). Faces that meet belong to different objects
    if one lies in front of the plane of the other, such as a box and a wall. Remaining points join the nearest
    part. Points far from all parts are clustered.

    Args:
        points: (P, 3) connected points [m].
        observers: (P, 3) camera centre from which each was observed [m], NaN where unknown. A face without a known
            observer is a part of its own.
        apart: maximum distance between neighbours of one part [m].
        fewest: minimum number of points of a part.
    """
    faces = _faces(points, observers, apart=apart, fewest=fewest)
    group = list(range(len(faces)))
    for i, a in enumerate(faces):
        for j, b in enumerate(faces[:i]):
            if group[i] != group[j] and _same_object(points, a, b, apart):
                group = [group[j] if g == group[i] else g for g in group]
    parts = [np.concatenate([f.rows for f, g in zip(faces, group, strict=True) if g == root]) for root in set(group)]
    owner = np.full(len(points), -1)
    for k, rows in enumerate(parts):
        owner[rows] = k
    left, known = np.flatnonzero(owner < 0), np.flatnonzero(owner >= 0)
    if len(left) and len(known):
        nearest, square = nearest_of(points[known], points[left])
        owner[left] = np.where(square < apart**2, owner[known[nearest]], -1)
    found = [np.flatnonzero(owner == k) for k in range(len(parts))]
    left = np.flatnonzero(owner < 0)
    found += [left[rows] for rows in clusters(points[left], apart=apart)]
    return sorted((rows for rows in found if len(rows) >= fewest), key=lambda rows: (-len(rows), int(rows[0])))


def _faces(points: Array, observers: Array, *, apart: float, fewest: int) -> list[_PlanarFace]:
    """Extract planes sequentially, assign each point to its nearest plane, and split planes into clusters."""
    normals = local_normals(points)
    rng = np.random.default_rng(0)
    left = np.arange(len(points))
    planes: list[tuple[Array, float]] = []
    least = max(fewest, int(CONSTANTS.min_plane_fraction * len(points)))
    while len(left) >= least and len(planes) < CONSTANTS.max_planes:
        plane = _largest_plane(points[left], normals[left], rng)
        on = _inliers(plane, points[left], normals[left])
        if on.sum() < least:
            break
        planes.append(plane)
        left = left[~on]
    if not planes:
        return []
    away = np.stack([np.where(_inliers(p, points, normals), np.abs(points @ p[0] - p[1]), np.inf) for p in planes])
    best = np.where(np.isfinite(away.min(axis=0)), away.argmin(axis=0), -1)
    found = []
    for k, (normal, _) in enumerate(planes):
        rows = np.flatnonzero(best == k)
        for part in clusters(points[rows], apart=apart):
            if len(part) >= fewest:
                found.append(_oriented(points, observers, rows[part], normal))
    return found


def _oriented(points: Array, observers: Array, rows: NDArray[np.int64], normal: Array) -> _PlanarFace:
    toward = (observers[rows] - points[rows]) @ normal
    toward = toward[np.isfinite(toward)]
    if not len(toward):
        return _PlanarFace(rows, np.full(3, np.nan), np.nan)
    normal = normal * (-1.0 if np.median(toward) < 0 else 1.0)
    return _PlanarFace(rows, normal, float(np.median(points[rows] @ normal)))


def _largest_plane(points: Array, normals: Array, rng: np.random.Generator) -> tuple[Array, float]:
    """Return the tangent plane with the most inliers among random points, refitted to its inliers."""
    sample = rng.choice(len(points), min(len(points), CONSTANTS.max_inlier_sample), replace=False)
    p, n = points[sample], normals[sample]
    candidates = [(n[k], float(p[k] @ n[k])) for k in range(min(CONSTANTS.plane_candidates, len(p)))]
    plane = candidates[int(np.argmax([_inliers(some, p, n).sum() for some in candidates]))]
    for _ in range(3):
        near = points[_inliers(plane, points, normals)]
        if len(near) < 3:
            break
        middle = near.mean(axis=0)
        normal = np.linalg.svd(near - middle, full_matrices=False)[2][2]
        plane = normal, float(middle @ normal)
    return plane


def _inliers(plane: tuple[Array, float], points: Array, normals: Array) -> NDArray[np.bool_]:
    normal, offset = plane
    return np.asarray(
        (np.abs(points @ normal - offset) < CONSTANTS.inlier_distance)
        & (np.abs(normals @ normal) > CONSTANTS.inlier_cosine)
    )


def _same_object(points: Array, a: _PlanarFace, b: _PlanarFace, apart: float) -> bool:
    """Return whether two faces meet at a convex edge: neither lies in front of the other."""
    p, q = points[a.rows], points[b.rows]
    if not (
        a.offset_of(q) < CONSTANTS.max_concave_offset and b.offset_of(p) < CONSTANTS.max_concave_offset
    ):  # NaN if unknown
        return False
    return bool((nearest_of(p, q)[1] < apart**2).sum() >= CONSTANTS.min_contact_points)

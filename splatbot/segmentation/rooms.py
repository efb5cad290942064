"""What hangs together and is too large for a thing, as a shelf and what leans on its walls: cut at concave edges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.protocols import Array
from splatbot.segmentation.clusters import clusters
from splatbot.segmentation.faces import local_normals, nearest_of

_TRIES, _MOST = 150, 16  # points whose planes are tried; planes
_LEAST = 0.01  # share of the points that a plane must have
_THICK = 0.008  # [m] that points of a plane are off by at most
_ALONG = 0.8  # cosine between the normal around a point and that of its plane
_BEFORE = 0.006  # [m] before a face that what belongs to it is at most
_MEET = 5  # points of a face that are near to another


@dataclass(frozen=True, eq=False)
class _RoomFace:
    """Points that hang together in a plane normal · p = offset; the normal points to who saw them."""

    rows: NDArray[np.int64]
    normal: Array
    offset: float

    def before(self, points: Array) -> float:
        """How far the middle of points (P, 3) is before it [m]."""
        return float(np.median(points @ self.normal) - self.offset)


def cut_in_room(points: Array, observers: Array, *, apart: float, fewest: int) -> list[NDArray[np.int64]]:
    """Rows of points (P, 3) [m] in parts, largest first: faces that meet at convex edges, and what is flat nowhere.

    Things bulge towards who sees them, rooms do not: where two faces meet and one is before the other, as what stands
    at a wall is before that wall, one thing ends (Stein et al. 2014, local convexity). Points that no face has go to
    what is nearest.

    Args:
        points: that hang together.
        observers: (P, 3) where each was seen from [m], NaN where that is not known. Faces of which nothing is known
            are parts of their own.
        apart: what is nearer than this hangs together [m].
        fewest: points of a part.
    """
    faces = _faces(points, observers, apart=apart, fewest=fewest)
    group = list(range(len(faces)))
    for i, a in enumerate(faces):
        for j, b in enumerate(faces[:i]):
            if group[i] != group[j] and _of_one(points, a, b, apart):
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


def _faces(points: Array, observers: Array, *, apart: float, fewest: int) -> list[_RoomFace]:
    """Planes one after the other, then each point in the nearest of them."""
    normals = local_normals(points)
    rng = np.random.default_rng(0)
    left = np.arange(len(points))
    planes: list[tuple[Array, float]] = []
    least = max(fewest, int(_LEAST * len(points)))
    while len(left) >= least and len(planes) < _MOST:
        plane = _largest(points[left], normals[left], rng)
        on = _on(plane, points[left], normals[left])
        if on.sum() < least:
            break
        planes.append(plane)
        left = left[~on]
    if not planes:
        return []
    away = np.stack([np.where(_on(p, points, normals), np.abs(points @ p[0] - p[1]), np.inf) for p in planes])
    best = np.where(np.isfinite(away.min(axis=0)), away.argmin(axis=0), -1)
    found = []
    for k, (normal, _) in enumerate(planes):
        rows = np.flatnonzero(best == k)
        for part in clusters(points[rows], apart=apart):
            if len(part) >= fewest:
                found.append(_turned(points, observers, rows[part], normal))
    return found


def _turned(points: Array, observers: Array, rows: NDArray[np.int64], normal: Array) -> _RoomFace:
    toward = (observers[rows] - points[rows]) @ normal
    toward = toward[np.isfinite(toward)]
    if not len(toward):
        return _RoomFace(rows, np.full(3, np.nan), np.nan)
    normal = normal * (-1.0 if np.median(toward) < 0 else 1.0)
    return _RoomFace(rows, normal, float(np.median(points[rows] @ normal)))


def _largest(points: Array, normals: Array, rng: np.random.Generator) -> tuple[Array, float]:
    """The plane of the point that most others share, fitted to them."""
    sample = rng.choice(len(points), min(len(points), 4000), replace=False)
    p, n = points[sample], normals[sample]
    tried = [(n[k], float(p[k] @ n[k])) for k in range(min(_TRIES, len(p)))]
    plane = tried[int(np.argmax([_on(some, p, n).sum() for some in tried]))]
    for _ in range(3):
        near = points[_on(plane, points, normals)]
        if len(near) < 3:
            break
        middle = near.mean(axis=0)
        normal = np.linalg.svd(near - middle, full_matrices=False)[2][2]
        plane = normal, float(middle @ normal)
    return plane


def _on(plane: tuple[Array, float], points: Array, normals: Array) -> NDArray[np.bool_]:
    normal, offset = plane
    return np.asarray((np.abs(points @ normal - offset) < _THICK) & (np.abs(normals @ normal) > _ALONG))


def _of_one(points: Array, a: _RoomFace, b: _RoomFace, apart: float) -> bool:
    """Whether two faces meet and none is before the other."""
    p, q = points[a.rows], points[b.rows]
    if not (a.before(q) < _BEFORE and b.before(p) < _BEFORE):  # NaN: not known
        return False
    return bool((nearest_of(p, q)[1] < apart**2).sum() >= _MEET)

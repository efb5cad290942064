"""Segmentation of connected points into smooth faces, and of touching objects at steps between parallel faces."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.protocols import Array


@dataclass(frozen=True)
class FaceConstants:
    """Constants of smooth faces."""

    neighbour_radius: float = 0.012
    """Largest distance [m] of a neighbour. A smaller one breaks faces of coarse maps, a larger one links faces across a
    gap."""
    max_neighbours: int = 24
    """Largest number of neighbours [1] of a point. It bounds time and memory."""
    min_neighbours: int = 6
    """Median number of neighbours [1], with the point itself, from which normals are reliable. Coarser maps are not
    split at steps."""
    min_coherence: float = 0.9
    """Smallest length [1] of the mean normal around a point of a face. A larger one excludes more points near edges."""
    parallel_cosine: float = 0.8
    """Smallest cosine [1] between normals of one face. A larger one splits curved faces."""
    level_cosine: float = 0.8
    """Smallest cosine [1] between the normal of a horizontal face and z."""
    max_step: float = 0.006
    """Largest distance [m] between neighbours of one face along their normal. A larger one merges objects that lie on
    each other."""
    min_contact_pairs: int = 5
    """Smallest number of pairs of neighbours [1] between two faces that meet."""
    min_seed_fraction: float = 0.5
    """Share [1] of the points of a face that must be seeds for it to be selected. A larger one selects fewer faces
    around a hint."""
    min_part_fraction: float = 0.02
    """Smallest share [1] of all points that a separate part has. A smaller one splits off noise."""


CONSTANTS = FaceConstants()


@dataclass(frozen=True, eq=False)
class Faces:
    """Smooth faces of points.

    Args:
        owner: (P,) face label of each point, -1 for none.
        numbers: labels of the faces.
        normals: (P, 3) unit normals of arbitrary sign.
        index: (P, K) indices of the nearest neighbours.
        near: (P, K) True for neighbours within 12 mm.
    """

    owner: NDArray[np.int64]
    numbers: list[int]
    normals: Array
    index: NDArray[np.int64]
    near: NDArray[np.bool_]

    def adjacent(self, a: int, b: int) -> bool:
        """Return whether two faces meet."""
        rows = np.flatnonzero(self.owner == a)
        return bool((self.near[rows] & (self.owner[self.index[rows]] == b)).sum() >= CONSTANTS.min_contact_pairs)

    def axis(self, number: int) -> Array:
        """Return the dominant normal (3,) of a face, of arbitrary sign: first principal axis of its normals."""
        n = self.normals[self.owner == number]
        return np.asarray(np.linalg.eigh(n.T @ n)[1][:, -1])


def find_faces(points: Array, *, fewest: int) -> Faces:
    """Find smooth faces of at least ``fewest`` points among points (P, 3) [m].

    A face is a connected component of neighbours with parallel normals and without a step between them. Points at
    edges, whose normals are not reliable, join the face of their nearest neighbour.
    """
    index, near = _neighbours(points)
    normals = _normals(points, index, near)
    aligned = normals[index] * np.sign(np.einsum("pki,pi->pk", normals[index], normals))[:, :, None]
    mean = np.where(near[:, :, None], aligned, 0.0).sum(axis=1) / np.maximum(near.sum(axis=1), 1)[:, None]
    flat = np.linalg.norm(mean, axis=1) > CONSTANTS.min_coherence
    between = points[index] - points[:, None]
    step = np.abs(np.einsum("pki,pki->pk", between, aligned + normals[:, None])) / 2
    parallel = np.einsum("pki,pi->pk", aligned, normals) > CONSTANTS.parallel_cosine
    linked = near & flat[:, None] & flat[index] & parallel & (step < CONSTANTS.max_step)
    label = np.where(flat, _components(len(points), index, linked), -1)
    numbers, counts = np.unique(label[flat], return_counts=True)
    big = [int(k) for k in numbers[counts >= fewest]]
    label[~np.isin(label, big)] = -1
    owner = _nearest_owner(points, label) if big else label
    return Faces(owner, big, normals, index, near)


def split_at_steps(points: Array, *, fewest: int) -> list[NDArray[np.int64]]:
    """Split points (P, 3) [m, z up] at steps between parallel faces; return the rows of each part, largest first.

    Faces that meet at an angle belong to one object, unless a side rises above a horizontal face. Parallel faces with a
    step between them belong to different objects. Points that are too sparse for normals are not split.
    """
    if len(points) < 2 * fewest:
        return [np.arange(len(points))]
    faces = find_faces(points, fewest=max(fewest, int(CONSTANTS.min_part_fraction * len(points))))
    if len(faces.numbers) < 2 or np.median(faces.near.sum(axis=1)) < CONSTANTS.min_neighbours:
        return [np.arange(len(points))]
    group = {face: face for face in faces.numbers}
    for i, a in enumerate(faces.numbers):
        for b in faces.numbers[i + 1 :]:
            if (
                abs(faces.axis(a) @ faces.axis(b)) < CONSTANTS.parallel_cosine
                and faces.adjacent(a, b)
                and _under(points, faces, a, b)
            ):
                old, new = group[b], group[a]
                group = {face: new if root == old else root for face, root in group.items()}
    roots = sorted(set(group.values()))
    parts = [np.flatnonzero(np.isin(faces.owner, [f for f in group if group[f] == root])) for root in roots]
    return sorted(parts, key=lambda rows: (-len(rows), int(rows[0])))


def _under(points: Array, faces: Faces, a: int, b: int) -> bool:
    """Return whether the side of two faces is below the horizontal one; a side above a top is another object."""
    up = [abs(float(faces.axis(k)[2])) for k in (a, b)]
    if max(up) < CONSTANTS.level_cosine:
        return True
    top, side = (a, b) if up[0] >= up[1] else (b, a)
    n = faces.axis(top)
    own, other = points[faces.owner == top], points[faces.owner == side]
    return float(np.median((other - own.mean(axis=0)) @ (n * np.sign(n[2])))) < CONSTANTS.max_step


def region(points: Array, seeds: NDArray[np.bool_], *, fewest: int) -> NDArray[np.int64]:
    """Return the rows of the faces of points (P, 3) [m] with more than half of their points in ``seeds`` (P,)."""
    faces = find_faces(points, fewest=fewest)
    chosen = [k for k in faces.numbers if seeds[faces.owner == k].mean() > CONSTANTS.min_seed_fraction]
    return np.flatnonzero(np.isin(faces.owner, chosen))


def local_normals(points: Array, rows: NDArray[np.int64] | None = None) -> Array:
    """Estimate normals (M, 3) of arbitrary sign from the neighbours within 12 mm of points (P, 3) [m].

    Args:
        points: (P, 3) [m].
        rows: (M,) points of which the normals are estimated. If None, all.
    """
    return _normals(points, *_neighbours(points, rows))


def _neighbours(points: Array, rows: NDArray[np.int64] | None = None) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """Return the nearest neighbours (M, K) of all points or of ``rows``, and a mask of those within 12 mm."""
    index, square = _search(
        points, points if rows is None else points[rows], min(CONSTANTS.max_neighbours, len(points))
    )
    return index, square < CONSTANTS.neighbour_radius**2


def _normals(points: Array, index: NDArray[np.int64], near: NDArray[np.bool_]) -> Array:
    """Return the eigenvectors (P, 3) of the smallest eigenvalue of the neighbours' covariance: normals by PCA."""
    weight = near[:, :, None].astype(np.float64)
    middle = (points[index] * weight).sum(axis=1) / weight.sum(axis=1)
    away = (points[index] - middle[:, None]) * weight
    return np.asarray(np.linalg.eigh(np.einsum("pki,pkj->pij", away, away))[1][:, :, 0])


def _components(count: int, index: NDArray[np.int64], linked: NDArray[np.bool_]) -> NDArray[np.int64]:
    """Label connected components (P,) by their smallest row."""
    a, k = np.nonzero(linked)
    b = index[a, k]
    label = np.arange(count)
    while True:
        before = label.copy()
        np.minimum.at(label, a, label[b])
        np.minimum.at(label, b, label[a])
        label = label[label]
        if (label == before).all():
            return label


def _nearest_owner(points: Array, owner: NDArray[np.int64]) -> NDArray[np.int64]:
    known = np.flatnonzero(owner >= 0)
    return np.asarray(owner[known[nearest_of(points[known], points)[0]]])


def nearest_of(points: Array, queries: Array) -> tuple[NDArray[np.int64], Array]:
    """Return the row of the point nearest to each query (Q, 3), and the squared distances (Q,) [m²]."""
    index, square = _search(points, queries, 1)
    return index[:, 0], square[:, 0]


def _search(points: Array, queries: Array, count: int) -> tuple[NDArray[np.int64], Array]:
    import open3d as o3d

    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor.from_numpy(np.ascontiguousarray(points)))
    search.knn_index()
    index, square = search.knn_search(o3d.core.Tensor.from_numpy(np.ascontiguousarray(queries)), count)
    return index.numpy().astype(np.int64), square.numpy()

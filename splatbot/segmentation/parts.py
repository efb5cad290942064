"""What hangs together, cut where one thing ends and another begins: at steps between level faces that touch."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from splatbot.protocols import Array

_REACH, _MOST = 0.012, 24  # [m] and how many neighbours
_ENOUGH = 6  # of them, itself among them, that a normal is told from; of fewer it is chance
_COHERENT = 0.9  # length of the mean normal around a point that lies in a face
_PARALLEL = 0.8  # cosine between normals of one face
_LEVEL = 0.8  # of a normal along z
_STEP = 0.006  # [m] along their normal that neighbours of one face are apart at most
_MEET = 5  # pairs of neighbours of two faces that meet
_MOSTLY = 0.5  # share of a face that is pointed at
_LEAST = 0.02  # share of the points that a part must have to be a thing of its own


@dataclass(frozen=True, eq=False)
class Faces:
    """Smooth faces that points belong to.

    Args:
        owner: (P,) the face of each point, -1 for none.
        numbers: of the faces.
        normals: (P, 3) unit; their sign means nothing.
        index: (P, K) the nearest points of each.
        near: (P, K) which of them are within 12 mm.
    """

    owner: NDArray[np.int64]
    numbers: list[int]
    normals: Array
    index: NDArray[np.int64]
    near: NDArray[np.bool_]

    def touch(self, a: int, b: int) -> bool:
        """Whether two faces meet."""
        rows = np.flatnonzero(self.owner == a)
        return bool((self.near[rows] & (self.owner[self.index[rows]] == b)).sum() >= _MEET)

    def axis(self, number: int) -> Array:
        """The direction (3,) that most normals of a face have, up to its sign."""
        n = self.normals[self.owner == number]
        return np.asarray(np.linalg.eigh(n.T @ n)[1][:, -1])


def find_faces(points: Array, *, fewest: int) -> Faces:
    """Faces of at least ``fewest`` of points (P, 3) [m].

    A face is what neighbours with parallel normals make up that have no step between them; points at edges, whose
    normals say nothing, go to the face of their nearest neighbour.
    """
    index, near = _neighbours(points)
    normals = _normals(points, index, near)
    aligned = normals[index] * np.sign(np.einsum("pki,pi->pk", normals[index], normals))[:, :, None]
    mean = np.where(near[:, :, None], aligned, 0.0).sum(axis=1) / np.maximum(near.sum(axis=1), 1)[:, None]
    flat = np.linalg.norm(mean, axis=1) > _COHERENT
    between = points[index] - points[:, None]
    step = np.abs(np.einsum("pki,pki->pk", between, aligned + normals[:, None])) / 2
    parallel = np.einsum("pki,pi->pk", aligned, normals) > _PARALLEL
    linked = near & flat[:, None] & flat[index] & parallel & (step < _STEP)
    label = np.where(flat, _components(len(points), index, linked), -1)
    numbers, counts = np.unique(label[flat], return_counts=True)
    big = [int(k) for k in numbers[counts >= fewest]]
    label[~np.isin(label, big)] = -1
    owner = _nearest_owner(points, label) if big else label
    return Faces(owner, big, normals, index, near)


def cut_at_steps(points: Array, *, fewest: int) -> list[NDArray[np.int64]]:
    """Rows of points (P, 3) [m], largest first, in parts that meet at steps only; one part if they do not fall apart.

    Faces that meet at an angle are of one thing, unless one rises from the other as from what it stands on; those that
    meet at a step between parallel ones are not. Points too sparse to have normals are not cut. z is up.
    """
    if len(points) < 2 * fewest:
        return [np.arange(len(points))]
    faces = find_faces(points, fewest=max(fewest, int(_LEAST * len(points))))
    if len(faces.numbers) < 2 or np.median(faces.near.sum(axis=1)) < _ENOUGH:
        return [np.arange(len(points))]
    group = {face: face for face in faces.numbers}
    for i, a in enumerate(faces.numbers):
        for b in faces.numbers[i + 1 :]:
            if abs(faces.axis(a) @ faces.axis(b)) < _PARALLEL and faces.touch(a, b) and _under(points, faces, a, b):
                old, new = group[b], group[a]
                group = {face: new if root == old else root for face, root in group.items()}
    roots = sorted(set(group.values()))
    parts = [np.flatnonzero(np.isin(faces.owner, [f for f in group if group[f] == root])) for root in roots]
    return sorted(parts, key=lambda rows: (-len(rows), int(rows[0])))


def _under(points: Array, faces: Faces, a: int, b: int) -> bool:
    """Whether a level face of two is the upper one: a side that rises above a top is of another thing."""
    up = [abs(float(faces.axis(k)[2])) for k in (a, b)]
    if max(up) < _LEVEL:
        return True
    top, side = (a, b) if up[0] >= up[1] else (b, a)
    n = faces.axis(top)
    own, other = points[faces.owner == top], points[faces.owner == side]
    return float(np.median((other - own.mean(axis=0)) @ (n * np.sign(n[2])))) < _STEP


def region(points: Array, seeds: NDArray[np.bool_], *, fewest: int) -> NDArray[np.int64]:
    """Rows of the faces of points (P, 3) [m] that lie mostly in ``seeds`` (P,), and of the seeds near to them."""
    faces = find_faces(points, fewest=fewest)
    chosen = [k for k in faces.numbers if seeds[faces.owner == k].mean() > _MOSTLY]
    return np.flatnonzero(np.isin(faces.owner, chosen))


def local_normals(points: Array, rows: NDArray[np.int64] | None = None) -> Array:
    """Directions (M, 3) in which the neighbours within 12 mm of points (P, 3) [m] spread least; of no sign.

    ``rows`` (M,): of these alone; None: of all.
    """
    return _normals(points, *_neighbours(points, rows))


def _neighbours(points: Array, rows: NDArray[np.int64] | None = None) -> tuple[NDArray[np.int64], NDArray[np.bool_]]:
    """The nearest of each point, or of those named, (P, K), and which of them are within 12 mm."""
    index, square = _search(points, points if rows is None else points[rows], min(_MOST, len(points)))
    return index, square < _REACH**2


def _normals(points: Array, index: NDArray[np.int64], near: NDArray[np.bool_]) -> Array:
    """Directions (P, 3) in which the neighbours spread least; their sign means nothing."""
    weight = near[:, :, None].astype(np.float64)
    middle = (points[index] * weight).sum(axis=1) / weight.sum(axis=1)
    away = (points[index] - middle[:, None]) * weight
    return np.asarray(np.linalg.eigh(np.einsum("pki,pkj->pij", away, away))[1][:, :, 0])


def _components(count: int, index: NDArray[np.int64], linked: NDArray[np.bool_]) -> NDArray[np.int64]:
    """The least row that each point (P,) is linked to, over any number of links."""
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
    """The row of points (P, 3) nearest to each of the queries (Q, 3), and the square of its distance [m²]."""
    index, square = _search(points, queries, 1)
    return index[:, 0], square[:, 0]


def _search(points: Array, queries: Array, count: int) -> tuple[NDArray[np.int64], Array]:
    search = o3d.core.nns.NearestNeighborSearch(o3d.core.Tensor.from_numpy(np.ascontiguousarray(points)))
    search.knn_index()
    index, square = search.knn_search(o3d.core.Tensor.from_numpy(np.ascontiguousarray(queries)), count)
    return index.numpy().astype(np.int64), square.numpy()

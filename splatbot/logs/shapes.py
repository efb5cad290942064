"""Triangle meshes of plain solids, in metres."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.geometry import so3_exp

_QUADS = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]  # corner = 4x + 2y + z
_FACETS = 72  # of a full turn


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """Vertices (V, 3) [m] and triangles (T, 3) of their indices."""

    vertices: NDArray[np.float64]
    triangles: NDArray[np.uint32]

    def placed(self, at: ArrayLike, yaw: float = 0.0) -> TriangleMesh:
        """Return the mesh rotated about z by ``yaw`` [rad] and then translated by ``at`` (3,) [m]."""
        return TriangleMesh(self.vertices @ so3_exp([0.0, 0.0, yaw]).T + np.asarray(at), self.triangles)

    def normals(self) -> NDArray[np.float64]:
        """Return unit normals (T, 3) of the triangles; 0 for a degenerate triangle."""
        a, b, c = (self.vertices[self.triangles[:, k]] for k in range(3))
        n = np.cross(b - a, c - a)
        return n / np.maximum(np.linalg.norm(n, axis=1, keepdims=True), np.finfo(np.float64).tiny)


def box(size: ArrayLike) -> TriangleMesh:
    """Build a box of ``size`` (3,) [m] that stands on z = 0, centred in x and y."""
    corners = np.array(list(product((-0.5, 0.5), (-0.5, 0.5), (0.0, 1.0)))) * np.asarray(size)
    triangles = [t for a, b, c, d in _QUADS for t in ((a, b, c), (a, c, d))]
    return TriangleMesh(corners, np.array(triangles, np.uint32))


def cylinder(radius: float, height: float) -> TriangleMesh:
    """Build a closed cylinder that stands on z = 0."""
    return lathe([(0, 0), (radius, 0), (radius, height), (0, height)])


def sphere(radius: float) -> TriangleMesh:
    """Build a sphere that touches z = 0."""
    angles = np.linspace(-np.pi / 2, np.pi / 2, _FACETS // 2)
    return lathe(np.column_stack([np.cos(angles), 1.0 + np.sin(angles)]) * radius)


def cup(radius: float, height: float, wall: float) -> TriangleMesh:
    """Build a hollow cylinder that is open at the top."""
    inner = radius - wall
    return lathe([(0, 0), (radius, 0), (radius, height), (inner, height), (inner, wall), (0, wall)])


def handle(radius: float, tube: float) -> TriangleMesh:
    """Build half a torus in the xz plane around the origin, open towards -x, with the tube radius ``tube`` [m]."""
    along, across = np.linspace(-np.pi / 2, np.pi / 2, _FACETS // 2), np.linspace(0, 2 * np.pi, _FACETS // 3)
    r = radius + tube * np.cos(across)
    y = np.broadcast_to(tube * np.sin(across), (len(along), len(across)))
    return _sheet(np.stack([np.outer(np.cos(along), r), y, np.outer(np.sin(along), r)], axis=-1))


def lathe(profile: ArrayLike) -> TriangleMesh:
    """Build the surface of revolution about z of a profile (P, 2) of (radius, z) [m]."""
    r, z = np.asarray(profile, dtype=np.float64).T
    turn = np.linspace(0.0, 2 * np.pi, _FACETS + 1)
    heights = np.broadcast_to(z[:, None], (len(z), len(turn)))
    return _sheet(np.stack([np.outer(r, np.cos(turn)), np.outer(r, np.sin(turn)), heights], axis=-1))


def _sheet(points: NDArray[np.float64]) -> TriangleMesh:
    """Triangulate a grid of points (A, B, 3)."""
    rows, columns = points.shape[:2]
    i = np.arange(rows * columns).reshape(rows, columns)
    a, b, c, d = i[:-1, :-1], i[1:, :-1], i[1:, 1:], i[:-1, 1:]
    triangles = np.concatenate([np.stack(t, axis=-1).reshape(-1, 3) for t in ((a, b, c), (a, c, d))])
    return TriangleMesh(points.reshape(-1, 3), triangles.astype(np.uint32))

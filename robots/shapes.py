"""Collision geometry of links: capsules, boxes and meshes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from splatbot.geometry import inverse, transform_points
from splatbot.protocols import Array

if TYPE_CHECKING:
    import open3d as o3d

_AROUND = 24  # corners of the rings of a capsule's mesh


class Shape(Protocol):
    """A solid that is fixed to a link."""

    @property
    def link(self) -> int:
        """Index of the link; 0 is the base."""
        ...

    def surface(self, spacing: float) -> Array:
        """Sample points (P, 3) of the surface in the link frame, at a distance of about ``spacing`` [m] or less."""
        ...

    def triangles(self) -> Array:
        """Return triangles (T, 3, 3) [m, link frame] that contain every point of the surface, or enclose it."""
        ...

    def depth(self, points: Array) -> Array:
        """Compute the depth (P,) [m] of points (P, 3) [m, link frame] below the surface; negative outside."""
        ...


@dataclass(frozen=True, eq=False)
class Capsule:
    """All points within ``radius`` [m] of the segment from ``start`` to ``end`` (3,) [m, link frame]."""

    link: int
    start: tuple[float, float, float]
    end: tuple[float, float, float]
    radius: float

    @property
    def length(self) -> float:
        """Length of the segment [m]."""
        return float(np.linalg.norm(np.subtract(self.end, self.start)))

    def along(self) -> Array:
        """Return the unit vector (3,) of the segment; it is x for a sphere."""
        d = np.subtract(self.end, self.start)
        return np.asarray(d / self.length) if self.length > 0 else np.array([1.0, 0.0, 0.0])

    def surface(self, spacing: float) -> Array:
        """Sample rings along the segment, and rings of latitude on both caps."""
        axis = self.along()
        side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        side /= np.linalg.norm(side)
        around = np.arange(max(8, int(np.ceil(2 * np.pi * self.radius / spacing)))) / max(
            8, int(np.ceil(2 * np.pi * self.radius / spacing))
        )
        turn = 2 * np.pi * around
        ring = np.outer(np.cos(turn), side) + np.outer(np.sin(turn), np.cross(axis, side))
        steps = np.linspace(0.0, 1.0, max(2, int(np.ceil(self.length / spacing)) + 1))
        start, end = np.asarray(self.start), np.asarray(self.end)
        rings = [start + t * (end - start) + self.radius * ring for t in steps]
        for angle in np.linspace(0, np.pi / 2, max(3, int(np.ceil(np.pi / 2 * self.radius / spacing)) + 1)):
            out = self.radius * np.sin(angle) * axis
            rings += [end + self.radius * np.cos(angle) * ring + out, start + self.radius * np.cos(angle) * ring - out]
        return np.concatenate(rings)

    def triangles(self) -> Array:
        """Return a mesh whose corners lie outside by at most 2 % of the radius, so that it encloses the capsule."""
        axis, turn = self.along(), 2 * np.pi * np.arange(_AROUND) / _AROUND
        side = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
        side /= np.linalg.norm(side)
        ring = np.outer(np.cos(turn), side) + np.outer(np.sin(turn), np.cross(axis, side))
        rise = np.linspace(-np.pi / 2, np.pi / 2, _AROUND // 2 + 2)
        rise = np.sort(np.r_[rise, 0.0])  # the equator twice: one ring for each end
        wide = self.radius / np.cos(np.pi / _AROUND) ** 2
        ends = np.where(np.arange(len(rise)) < len(rise) // 2, 0, 1)
        at = np.array([self.start, self.end])[ends]
        rings = at[:, None] + wide * (np.cos(rise)[:, None, None] * ring + np.sin(rise)[:, None, None] * axis)
        quads = np.stack(
            [rings[:-1], np.roll(rings[:-1], -1, axis=1), np.roll(rings[1:], -1, axis=1), rings[1:]], axis=2
        )
        quads = quads.reshape(-1, 4, 3)
        return np.concatenate([quads[:, [0, 1, 2]], quads[:, [0, 2, 3]]])

    def depth(self, points: Array) -> Array:
        """Compute the depth (P,) [m] of points (P, 3) [m, link frame] below the surface; negative outside."""
        start, line = np.asarray(self.start), np.subtract(self.end, self.start)
        along = np.clip((points - start) @ line / max(float(line @ line), 1e-30), 0.0, 1.0)
        return np.asarray(self.radius - np.linalg.norm(points - start - along[:, None] * line, axis=1))


@dataclass(frozen=True, eq=False)
class Box:
    """A box of ``size`` (3,) [m] whose centre has the pose ``T_link_box`` (4, 4)."""

    link: int
    T_link_box: Array
    size: tuple[float, float, float]

    def surface(self, spacing: float) -> Array:
        """Sample a grid on each face."""
        half = np.asarray(self.size) / 2
        faces = []
        for k in range(3):
            u, v = (k + 1) % 3, (k + 2) % 3
            lines = [np.linspace(-half[i], half[i], max(2, int(np.ceil(self.size[i] / spacing)) + 1)) for i in (u, v)]
            grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 2)
            for sign in (-1.0, 1.0):
                face = np.empty((len(grid), 3))
                face[:, k], face[:, [u, v]] = sign * half[k], grid
                faces.append(face)
        return transform_points(self.T_link_box, np.concatenate(faces))

    def triangles(self) -> Array:
        """Return the twelve triangles (12, 3, 3) [m, link frame]."""
        half = np.asarray(self.size) / 2
        corners = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)]) * half
        quads = [(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)]
        rows = np.array([t for a, b, c, d in quads for t in ((a, b, c), (a, c, d))])
        return transform_points(self.T_link_box, corners)[rows]

    def depth(self, points: Array) -> Array:
        """Compute the depth (P,) [m] of points (P, 3) [m, link frame] below the surface; negative outside."""
        local = transform_points(inverse(self.T_link_box), points)
        return np.asarray((np.asarray(self.size) / 2 - np.abs(local)).min(axis=1))


@dataclass(frozen=True, eq=False)
class Mesh:
    """A triangle mesh: vertices (V, 3) [m, link frame] and rows of its faces (T, 3).

    Args:
        link: index of the link; 0 is the base.
        vertices: (V, 3) [m, link frame].
        faces: (T, 3) rows of vertices; those of a closed mesh are counter-clockwise from outside.
        closed: whether the mesh bounds a volume. No point is inside an open one.
    """

    link: int
    vertices: Array = field(repr=False)
    faces: NDArray[np.int64] = field(repr=False)
    closed: bool = True

    @cached_property
    def _scene(self) -> o3d.t.geometry.RaycastingScene:
        import open3d as o3d

        scene = o3d.t.geometry.RaycastingScene()
        vertices, faces = self.vertices.astype(np.float32), self.faces.astype(np.uint32)
        scene.add_triangles(o3d.core.Tensor.from_numpy(vertices), o3d.core.Tensor.from_numpy(faces))
        return scene

    def triangles(self) -> Array:
        """Return the triangles (T, 3, 3) [m, link frame]."""
        return np.asarray(self.vertices[self.faces], dtype=np.float64)

    def depth(self, points: Array) -> Array:
        """Compute the depth (P,) [m] of points (P, 3) [m, link frame] below the surface; negative outside."""
        import open3d as o3d

        queries = o3d.core.Tensor.from_numpy(np.ascontiguousarray(points, dtype=np.float32))
        if not self.closed:
            return np.asarray(-self._scene.compute_distance(queries).numpy(), dtype=np.float64)
        return np.asarray(-self._scene.compute_signed_distance(queries, nsamples=5).numpy(), dtype=np.float64)

    def surface(self, spacing: float) -> Array:
        """Sample barycentric grids on the triangles."""
        a, b, c = (self.vertices[self.faces[:, k]] for k in range(3))
        edge = np.max(
            [np.linalg.norm(b - a, axis=1), np.linalg.norm(c - b, axis=1), np.linalg.norm(a - c, axis=1)], axis=0
        )
        points = [self.vertices]
        for parts in np.unique(steps := np.ceil(edge / spacing).astype(int)):
            chosen = steps == parts
            i, j = np.meshgrid(np.arange(parts + 1), np.arange(parts + 1), indexing="ij")
            inside = (i + j <= parts).ravel()
            u, v = i.ravel()[inside] / max(parts, 1), j.ravel()[inside] / max(parts, 1)
            corners = a[chosen, None], b[chosen, None], c[chosen, None]
            grid = corners[0] + u[:, None] * (corners[1] - corners[0]) + v[:, None] * (corners[2] - corners[0])
            points.append(grid.reshape(-1, 3))
        return np.concatenate(points)


def winding_number(triangles: Array, points: Array) -> Array:
    """Compute the winding number (P,) of a mesh about points: 1 inside of a closed mesh, 0 outside.

    It is the sum of the solid angles Ω of the triangles over 4 π (Van Oosterom and Strackee 1983, equation 8)::

        tan(Ω / 2) = det(a, b, c) / (|a| |b| |c| + (a·b) |c| + (b·c) |a| + (c·a) |b|)

    Args:
        triangles: (T, 3, 3) [m], counter-clockwise from outside.
        points: (P, 3) [m].
    """
    x, y, z = ((triangles[None, :, :, k] - points[:, None, None, k]).astype(np.float32) for k in range(3))  # (P, T, 3)
    size = np.sqrt(x * x + y * y + z * z)

    def dot(i: int, j: int) -> NDArray[np.float32]:
        """Return the scalar products (P, T) of the vectors to corners i and j."""
        return np.asarray(x[..., i] * x[..., j] + y[..., i] * y[..., j] + z[..., i] * z[..., j])

    volume = (
        x[..., 0] * (y[..., 1] * z[..., 2] - z[..., 1] * y[..., 2])
        + y[..., 0] * (z[..., 1] * x[..., 2] - x[..., 1] * z[..., 2])
        + z[..., 0] * (x[..., 1] * y[..., 2] - y[..., 1] * x[..., 2])
    )
    below = (
        size[..., 0] * size[..., 1] * size[..., 2]
        + dot(0, 1) * size[..., 2]
        + dot(1, 2) * size[..., 0]
        + dot(2, 0) * size[..., 1]
    )
    return np.asarray(np.arctan2(volume, below).sum(axis=1, dtype=np.float64) / (2 * np.pi))


def depth_of(shapes: Sequence[Shape], points: Array) -> Array:
    """Compute the depth (P,) [m] of points (P, 3) [m, link frame] below the surface of the shapes of one link.

    It is negative outside of all shapes: minus the distance from the nearest.
    """
    return np.asarray(np.max([shape.depth(points) for shape in shapes], axis=0))


def distance_of(shapes: Sequence[Shape], points: Array) -> Array:
    """Compute the distance (P,) [m] of points (P, 3) [m, link frame] from the shapes of one link; 0 inside."""
    return np.maximum(-depth_of(shapes, points), 0.0)

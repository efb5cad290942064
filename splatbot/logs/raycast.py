"""Textured meshes, still and moving, seen by casting one ray through each pixel centre."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.logs.shapes import TriangleMesh
from splatbot.logs.textures import Texture

Array = NDArray[np.float64]

_LIGHT = np.array([-0.4, -0.6, 1.2]) / np.linalg.norm([-0.4, -0.6, 1.2])
_AMBIENT = 0.45


@dataclass(frozen=True)
class RaycastSurface:
    """A mesh and its colour."""

    mesh: TriangleMesh
    texture: Texture


@dataclass(frozen=True)
class Moving:
    """An object that moves, appears or goes.

    Args:
        surfaces: in the object's own frame.
        pose: T_world_object (4, 4) at a time [s]; None while the object is not there.
    """

    surfaces: Sequence[RaycastSurface]
    pose: Callable[[float], Array | None]


class RaycastScene:
    """Surfaces in the world frame, and moving objects by name, under one distant light (Lambert, no shadows)."""

    def __init__(self, surfaces: Sequence[RaycastSurface], moving: Mapping[str, Moving] | None = None) -> None:
        self._still = _Body(surfaces)
        self._moving = {name: (thing.pose, _Body(thing.surfaces)) for name, thing in (moving or {}).items()}

    @property
    def surfaces(self) -> list[RaycastSurface]:
        """What does not move."""
        return self._still.surfaces

    def objects(self, t: float) -> dict[str, Array]:
        """T_world_object (4, 4) of each moving object that is there at time ``t`` [s]."""
        poses = {name: pose(t) for name, (pose, _) in self._moving.items()}
        return {name: T for name, T in poses.items() if T is not None}

    def render(
        self, camera: Camera, T_world_camera: Array, t: float = 0.0
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Colour (H, W, 3) and exact depth (H, W) [m] at time ``t`` [s]; both 0 where a ray hits nothing."""
        origin, directions = T_world_camera[:3, 3], _directions(camera, T_world_camera[:3, :3])
        colors = np.zeros_like(directions)
        # The directions have z = 1 in the camera frame, so the ray parameter is the depth.
        depth = np.full(len(directions), np.inf)
        for view in self._views(origin, directions, t):
            nearer = view.reach < depth
            depth[nearer] = view.reach[nearer]
            colors[nearer] = view.colors(nearer)
        rgb = np.rint(255.0 * colors).astype(np.uint8)
        depth[np.isinf(depth)] = 0.0
        shape = (camera.height, camera.width)
        return rgb.reshape(*shape, 3), depth.astype(np.float32).reshape(shape)

    def reach(self, origin: Array, directions: Array, t: float = 0.0) -> Array:
        """How far (N,) rays from ``origin`` (3,) [m] along ``directions`` (N, 3) go, in their lengths; inf: no hit."""
        return np.minimum.reduce([view.reach for view in self._views(origin, directions, t)])

    def moving_mask(self, camera: Camera, T_world_camera: Array, t: float) -> NDArray[np.bool_]:
        """Pixels (H, W) that show a moving object at time ``t`` [s]."""
        views = list(self._views(T_world_camera[:3, 3], _directions(camera, T_world_camera[:3, :3]), t))
        moving = np.minimum.reduce([np.full_like(views[0].reach, np.inf), *(view.reach for view in views[1:])])
        return np.asarray(moving < views[0].reach).reshape(camera.height, camera.width)

    def _views(self, origin: Array, directions: Array, t: float) -> list[_View]:
        """What the rays hit of the still surfaces, and of each moving object by itself."""
        views = [self._still.cast(origin, directions, _LIGHT)]
        for name, T in self.objects(t).items():  # into the object's frame: nothing is built anew as it moves
            R, p = T[:3, :3], T[:3, 3]
            views.append(self._moving[name][1].cast((origin - p) @ R, _rotate(directions, R.T), _LIGHT @ R))
        return views


class _Body:
    """Surfaces that move as one. Open3D says which triangle a ray hits, the place is then found in float64."""

    def __init__(self, surfaces: Sequence[RaycastSurface]) -> None:
        self.surfaces = list(surfaces)
        self._caster = o3d.t.geometry.RaycastingScene()
        normals, offsets = [], []
        for surface in self.surfaces:  # geometry ids count from 0 in this order
            mesh = surface.mesh
            self._caster.add_triangles(_tensor(mesh.vertices.astype(np.float32)), _tensor(mesh.triangles))
            normals.append(mesh.normals())
            offsets.append(np.sum(normals[-1] * mesh.vertices[mesh.triangles[:, 0]], axis=1))
        counts = [len(surface.mesh.triangles) for surface in self.surfaces]
        self._first = np.concatenate([[0], np.cumsum(counts)]).astype(np.int64)
        self.normals, self._offsets = np.concatenate(normals), np.concatenate(offsets)

    def cast(self, origin: Array, directions: Array, light: Array) -> _View:
        """What rays from ``origin`` (3,) along ``directions`` (N, 3) hit, all in the body's frame."""
        rays = np.empty((len(directions), 6), np.float32)
        rays[:, :3], rays[:, 3:] = origin, directions
        hits = self._caster.cast_rays(_tensor(rays))
        hit = np.isfinite(hits["t_hit"].numpy())
        ids = np.where(hit, hits["geometry_ids"].numpy(), 0).astype(np.int64)
        triangles = self._first[ids] + np.where(hit, hits["primitive_ids"].numpy(), 0)
        normals = self.normals[triangles]
        slopes = np.einsum("ij,ij->i", normals, directions)
        with np.errstate(divide="ignore", invalid="ignore"):  # where nothing was hit
            reach = np.where(hit, (self._offsets[triangles] - normals @ origin) / slopes, np.inf)
        return _View(self, origin, directions, light, reach, ids, triangles, slopes)


@dataclass(frozen=True)
class _View:
    """What N rays hit of one body, in its frame: how far, which surface and triangle; slopes: normal · direction."""

    body: _Body = field(repr=False)
    origin: Array
    directions: Array
    light: Array
    reach: Array
    ids: NDArray[np.int64]
    triangles: NDArray[np.int64]
    slopes: Array

    def colors(self, rows: NDArray[np.bool_]) -> Array:
        """Shaded colours (M, 3) in 0..1 of the rays that a mask (N,) names; they all hit."""
        points = self.origin + self.reach[rows, None] * self.directions[rows]
        ids, colors = self.ids[rows], np.empty_like(points)
        for number, surface in enumerate(self.body.surfaces):
            seen = ids == number
            if seen.any():
                colors[seen] = surface.texture.albedo(points[seen])
        towards = -np.sign(self.slopes[rows])  # meshes have no inside
        lambert = np.clip(towards * (self.body.normals @ self.light)[self.triangles[rows]], 0.0, 1.0)
        return colors * (_AMBIENT + (1.0 - _AMBIENT) * lambert)[:, None]


def _directions(camera: Camera, R_world_camera: Array) -> Array:
    """Rays (H·W, 3) through the pixel centres, in the world, of depth 1; the float32 rays that a Camera works with."""
    rays = camera.backproject(np.ones((camera.height, camera.width), np.float32)).reshape(-1, 3)
    return _rotate(rays.astype(np.float64), R_world_camera)


def _rotate(vectors: Array, R: Array) -> Array:
    """``vectors @ R.T`` column by column: three times as fast as BLAS on such a thin product."""
    x, y, z = vectors.T
    out = np.empty_like(vectors)
    for k in range(3):
        out[:, k] = R[k, 0] * x + R[k, 1] * y + R[k, 2] * z
    return out


def _tensor(array: NDArray[Any]) -> o3d.core.Tensor:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array))

"""Scenes of textured meshes, seen by casting one ray through each pixel centre."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.geometry import transform_points
from splatbot.logs.shapes import Mesh, box, cup, cylinder, handle, sphere
from splatbot.logs.textures import Texture

_LIGHT = np.array([-0.4, -0.6, 1.2]) / np.linalg.norm([-0.4, -0.6, 1.2])
_AMBIENT = 0.45


@dataclass(frozen=True)
class Surface:
    """A mesh and its colour."""

    mesh: Mesh
    texture: Texture


class Scene:
    """Surfaces in the world frame under one distant light (Lambert, no shadows)."""

    def __init__(self, surfaces: Sequence[Surface]) -> None:
        self.surfaces = list(surfaces)
        self._caster = o3d.t.geometry.RaycastingScene()
        for surface in self.surfaces:  # geometry ids count from 0 in this order
            vertices, triangles = surface.mesh.vertices.astype(np.float32), surface.mesh.triangles
            self._caster.add_triangles(_tensor(vertices), _tensor(triangles))

    def render(
        self, camera: Camera, T_world_camera: NDArray[np.float64]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Colour (H, W, 3) and exact depth (H, W) [m], 0 where a ray hits nothing."""
        rays = camera.backproject(np.ones((camera.height, camera.width), np.float32)).reshape(-1, 3)
        directions = rays.astype(np.float64) @ T_world_camera[:3, :3].T
        origins = np.broadcast_to(T_world_camera[:3, 3], directions.shape)
        cast = self._caster.cast_rays(_tensor(np.hstack([origins, directions]).astype(np.float32)))
        # The directions have z = 1 in the camera frame, so the ray parameter is the depth.
        depth = np.nan_to_num(cast["t_hit"].numpy(), posinf=0.0)
        points = transform_points(T_world_camera, rays * depth[:, None])
        rgb = self._shade(points, cast["primitive_normals"].numpy(), directions, cast["geometry_ids"].numpy())
        shape = (camera.height, camera.width)
        return rgb.reshape(*shape, 3), depth.reshape(shape)

    def _shade(
        self,
        points: NDArray[np.float64],
        normals: NDArray[np.float32],
        directions: NDArray[np.float64],
        ids: NDArray[np.uint32],
    ) -> NDArray[np.uint8]:
        colors = np.zeros_like(points)
        for number, surface in enumerate(self.surfaces):
            seen = ids == number
            colors[seen] = surface.texture.albedo(points[seen])
        towards = np.where(np.sum(normals * directions, axis=1) > 0, -1.0, 1.0)  # meshes have no inside
        light = _AMBIENT + (1.0 - _AMBIENT) * np.clip(towards * (normals @ _LIGHT), 0.0, 1.0)
        return np.rint(255.0 * colors * light[:, None]).astype(np.uint8)


def _tensor(array: NDArray[Any]) -> o3d.core.Tensor:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(array))


def tabletop() -> Scene:
    """A table (top at z = 0, z up) in the corner of a room, with two boxes, a can, a ball and a mug on it."""
    wood = Texture((0.80, 0.62, 0.42), (0.45, 0.30, 0.18), 0.04)
    wall = Texture((0.85, 0.85, 0.80), (0.55, 0.62, 0.68), 0.12, seed=1)
    floor = Texture((0.60, 0.58, 0.55), (0.30, 0.30, 0.33), 0.30, "checker")
    carton = Texture((0.90, 0.80, 0.25), (0.70, 0.20, 0.15), 0.035, seed=2)
    book = Texture((0.90, 0.90, 0.95), (0.10, 0.20, 0.55), 0.05, "checker", seed=3)
    can = Texture((0.20, 0.70, 0.35), (0.90, 0.90, 0.85), 0.03, seed=4)
    ball = Texture((0.95, 0.55, 0.15), (0.35, 0.10, 0.40), 0.03, seed=5)
    glaze = Texture((0.85, 0.88, 0.92), (0.15, 0.40, 0.60), 0.025, seed=6)
    mug_at, mug_yaw = np.array([0.22, -0.12, 0.0]), -0.9
    mug_handle = np.array([0.040 * np.cos(mug_yaw), 0.040 * np.sin(mug_yaw), 0.05]) + mug_at
    return Scene(
        [
            Surface(box([1.2, 0.8, 0.04]).placed([0, 0, -0.04]), wood),
            Surface(box([6.0, 6.0, 0.02]).placed([0, 0, -0.76]), floor),
            Surface(box([6.0, 0.02, 3.0]).placed([0, 0.75, -0.75]), wall),
            Surface(box([0.02, 6.0, 3.0]).placed([-1.1, 0, -0.75]), wall),
            Surface(box([0.16, 0.10, 0.12]).placed([-0.22, 0.05, 0], 0.5), carton),
            Surface(box([0.20, 0.14, 0.03]).placed([-0.05, -0.16, 0], -0.25), book),
            Surface(cylinder(0.035, 0.12).placed([0.08, 0.12, 0]), can),
            Surface(sphere(0.05).placed([-0.30, -0.18, 0]), ball),
            Surface(cup(0.042, 0.10, 0.004).placed(mug_at), glaze),
            Surface(handle(0.028, 0.006).placed(mug_handle, mug_yaw), glaze),
        ]
    )


SCENES = {"tabletop": tabletop}

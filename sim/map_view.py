"""The Gaussian map of a twin as rendered by the rasterizer; Gaussians of movable objects move with their bodies."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import torch

from splatbot.camera import Camera
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, pose_from_quat, quat_multiply, rotation_to_quat, transform_points
from splatbot.protocols import Array
from splatbot.rasterize.views import render_rgbd
from splatbot.sim.clutter import REPRESENTED
from splatbot.sim.solids import pose_at
from splatbot.sim.view import TwinView
from splatbot.sim.world import OBJECT, World

_MIN_ALPHA = 1.0 / 255.0  # opacity below one 8-bit step


class MapView:
    """A map in its scene's frame.

    Args:
        world: a compiled scene that has a map.
        camera: any pinhole.
    """

    def __init__(self, world: World, camera: Camera) -> None:
        parts = world.parts
        assert parts is not None
        assert world.scene.map is not None
        shown = np.flatnonzero(parts.labels != REPRESENTED)
        self.camera, self._model = camera, parts.model.select(torch.from_numpy(shown))
        self._sh_degree = world.harmonics
        self._T_world_map = pose_at(world.scene.map.at, world.scene.map.rpy)
        self._loose = [
            (
                int(world.model.body(OBJECT + obj.name).id),
                torch.from_numpy(np.flatnonzero(parts.labels[shown] == label)),
            )
            for label, obj in enumerate(parts.objects)
            if obj.movable
        ]
        self._T_start_world = {
            body: inverse(pose_from_quat(world.model.body_pos[body], world.model.body_quat[body]))
            for body, _ in self._loose
        }

    def view(self, data: Any, T_world_camera: Array) -> TwinView:
        """Render the map from a pose (4, 4)."""
        T_map_camera = inverse(self._T_world_map) @ T_world_camera
        rgb, alpha, depth = render_rgbd(self._placed(data), self.camera, T_map_camera, sh_degree=self._sh_degree)
        seen = np.where(alpha > _MIN_ALPHA, depth, np.float32(np.inf))
        return TwinView(rgb, alpha, seen, np.zeros_like(alpha))

    def _placed(self, data: Any) -> GaussianModel:
        """Return the map with the Gaussians of each movable body at the body's pose; harmonics are not rotated."""
        if not self._loose:
            return self._model
        means, quats = self._model.means.clone(), self._model.quats.clone()
        for body, rows in self._loose:
            T_world_body = pose_from_quat(data.xpos[body], data.xquat[body])
            T = inverse(self._T_world_map) @ T_world_body @ self._T_start_world[body] @ self._T_world_map
            means[rows] = torch.from_numpy(transform_points(T, means[rows].double().numpy())).float()
            turned = quat_multiply(rotation_to_quat(T[:3, :3]), quats[rows].double().numpy())
            quats[rows] = torch.from_numpy(turned).float()
        return replace(self._model, means=means, quats=quats)

"""The twin's camera: bodies by MuJoCo, a map by its Gaussians, composited by depth, and simulated sensor effects."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.protocols import Array
from splatbot.sim.bodies_view import BodiesView
from splatbot.sim.effects.registry import make_effects
from splatbot.sim.effects.sensors import sensor_specs
from splatbot.sim.map_view import MapView
from splatbot.sim.scene import CameraSection
from splatbot.sim.view import TwinView, composite
from splatbot.sim.world import World, robot_joints
from splatbot.trajectory import Trajectory


@dataclass(frozen=True)
class TwinCameraConstants:
    """Constants of the twin's camera.

    Args:
        max_range: [m] range of the depth camera.
        stamp_tolerance: [s] time by which a frame may be late.
    """

    max_range: float = 20.0
    stamp_tolerance: float = 1e-9


CONSTANTS = TwinCameraConstants()


class TwinCamera:
    """Renders frames of a twin. Effects that the scene's sensor does not name are neither imported nor called.

    Args:
        world: a compiled scene with a camera.
        seed: of the sensor's noise.
        splats: render the scene's map, if it has one, as Gaussians instead of its collision geometry.
        camera: a pinhole that replaces the scene's.

    Raises:
        InputError: the scene has no camera, or its sensor names an unknown effect.
        NativeError: rendering is not available on this machine.
    """

    def __init__(self, world: World, *, seed: int = 0, splats: bool = True, camera: Camera | None = None) -> None:
        if world.scene.camera is None:
            raise InputError("has no camera.", field=world.scene.name, hint="add `camera: {at: ..., look_at: ...}`")
        section: CameraSection = world.scene.camera
        self.camera = intrinsics(section) if camera is None else camera
        self.T_world_camera = pose_of(section)
        still = Trajectory(np.zeros(1), self.T_world_camera[None])
        why = f"sensor of the scene {world.scene.name}"
        self.effects = make_effects(sensor_specs(world.scene), seed=seed, why=why).along(still)
        self._in_transit: list[Frame] = []
        self._qpos = robot_joints(world.model, world.robot)[0] if world.robot is not None else None
        self._map = MapView(world, self.camera) if splats and world.parts is not None else None
        self._bodies = BodiesView(world, self.camera, map_too=self._map is None)

    def view(self, data: Any, T_world_camera: Array | None = None) -> TwinView:
        """Render the view of an ideal camera now, from the scene's camera pose or from another pose (4, 4)."""
        T = self.T_world_camera if T_world_camera is None else T_world_camera
        bodies = self._bodies.view(data, T)
        return bodies if self._map is None else composite(bodies, self._map.view(data, T))

    def frame(self, data: Any, index: int, stamp: float) -> Frame | None:
        """Return the newest frame that arrives at ``stamp`` [s], with the joints (J,) at that time, or None.

        Without latency it is the current view, or None if the sensor drops the frame.
        """
        seen = self.view(data)
        frame = Frame(stamp, seen.rgb(), seen.measured(CONSTANTS.max_range), self.camera, index, source=f"twin#{index}")
        self._in_transit.extend(self.effects.over([frame]))
        arrived = [pending for pending in self._in_transit if pending.stamp <= stamp + CONSTANTS.stamp_tolerance]
        self._in_transit = [
            pending for pending in self._in_transit if pending.stamp > stamp + CONSTANTS.stamp_tolerance
        ]
        return replace(arrived[-1], joints=self._joints(data)) if arrived else None

    def _joints(self, data: Any) -> Array | None:
        return None if self._qpos is None else np.array(data.qpos[self._qpos])

    def report(self) -> list[dict[str, Any]]:
        """Return the report of the sensor's effects."""
        return self.effects.report()

    def close(self) -> None:
        """Release the rendering context."""
        self._bodies.close()


def intrinsics(section: CameraSection) -> Camera:
    """Return the pinhole camera of a scene's camera section."""
    f = 0.5 * section.height / float(np.tan(0.5 * section.fov_y))
    return Camera(f, f, (section.width - 1) / 2, (section.height - 1) / 2, section.width, section.height)


def pose_of(section: CameraSection) -> Array:
    """Return T_world_camera (4, 4) with OpenCV's axes.

    Raises:
        InputError: the viewing direction is vertical or undefined.
    """
    at, target = np.asarray(section.at), np.asarray(section.look_at)
    forward = target - at
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:
        raise InputError("looks straight up or down.", field="camera.look_at", hint="move it slightly sideways")
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = at
    return T

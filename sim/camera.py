"""The twin's camera: MuJoCo's images and depth as a robot's camera would give them, through its sensor effects."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from splatbot.camera import Camera
from splatbot.errors import InputError, NativeError
from splatbot.frame import Frame
from splatbot.protocols import Array
from splatbot.sim.effects.registry import make_effects
from splatbot.sim.scene import CameraSection
from splatbot.sim.world import CAMERA, World


class TwinCamera:
    """Draws frames of a twin. What the scene's sensor does not name is neither imported nor called.

    Args:
        world: a compiled scene with a camera.
        seed: of the sensor's noise.

    Raises:
        InputError: the scene has no camera, or its sensor names an unknown effect.
        NativeError: nothing can be drawn on this machine.
    """

    def __init__(self, world: World, *, seed: int = 0) -> None:
        if world.scene.camera is None:
            raise InputError("has no camera.", field=world.scene.name, hint="add `camera: {at: ..., look_at: ...}`")
        section: CameraSection = world.scene.camera
        self.camera = intrinsics(section)
        self.effects = make_effects(section.sensor, seed=seed, why=f"sensor of the scene {world.scene.name}")
        try:
            self._renderer = mujoco.Renderer(world.model, section.height, section.width)
        except Exception as error:  # EGL, OSMesa and GLFW each fail with their own kinds
            raise NativeError(
                f"MuJoCo cannot draw here: {error}.", field="camera", hint="install libegl1 and set MUJOCO_GL=egl"
            ) from error

    def frame(self, data: Any, index: int, stamp: float) -> Frame | None:
        """What the camera sees now; None if the sensor loses the frame."""
        self._renderer.disable_depth_rendering()
        self._renderer.update_scene(data, CAMERA)
        rgb = self._renderer.render().copy()
        self._renderer.enable_depth_rendering()
        self._renderer.update_scene(data, CAMERA)
        depth = self._renderer.render().astype(np.float32)
        depth[depth > 20.0] = 0.0  # the sky, and what no depth camera reaches
        frame = Frame(stamp, rgb, depth, self.camera, index, source=f"twin#{index}")
        return next(iter(self.effects.over([frame])), None)

    def report(self) -> list[dict[str, Any]]:
        """The account of the sensor's effects."""
        return self.effects.report()

    def close(self) -> None:
        """Give the drawing context back."""
        self._renderer.close()


def intrinsics(section: CameraSection) -> Camera:
    """The pinhole camera of a scene's camera section."""
    f = 0.5 * section.height / float(np.tan(0.5 * section.fov_y))
    return Camera(f, f, (section.width - 1) / 2, (section.height - 1) / 2, section.width, section.height)


def pose_of(section: CameraSection) -> Array:
    """T_world_camera (4, 4), axes as OpenCV's.

    Raises:
        InputError: it looks straight up or down, or at itself.
    """
    at, target = np.asarray(section.at), np.asarray(section.look_at)
    forward = target - at
    right = np.cross(forward, [0.0, 0.0, 1.0])
    if np.linalg.norm(right) < 1e-6:
        raise InputError("looks straight up or down.", field="camera.look_at", hint="move it a little aside")
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.stack([right, np.cross(forward, right), forward], axis=1)
    T[:3, 3] = at
    return T

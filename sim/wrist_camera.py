"""The wrist camera of a twin's arm, for a look before the fingers close."""

from __future__ import annotations

import mujoco
import numpy as np

from splatbot.camera import Camera
from splatbot.collision.visibility import DepthView
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.geometry import inverse
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.sim.effects.registry import make_effects
from splatbot.sim.motion import base_of
from splatbot.sim.rays import cast, pixel_rays
from splatbot.sim.twin import Twin
from splatbot.sim.wrist import T_PANDA_CAMERA

_RANGE = 1.5  # [m]
_TRIES = 10  # frames that the sensor may drop in a row


class TwinWristCamera:
    """Depth camera on the last link; depth is cast against the collision geometry, with the scene's sensor effects.

    It has the same pose relative to the tool on every arm, that of the Panda's bracket.

    Args:
        twin: with an arm.
        T_world_base: (4, 4) pose of the base in the map. If None, the map is in the twin's world.
        width: of the image [px]; the height is 3/4 of it.
        seed: of the sensor's noise.

    Raises:
        InputError: the twin has no arm.
    """

    def __init__(
        self,
        twin: Twin,
        *,
        T_world_base: Array | None = None,
        width: int = 320,
        seed: int = 0,
    ) -> None:
        robot = twin.world.robot
        if robot is None or twin.follower is None:
            raise InputError("has no robot.", field=twin.scene.name, hint="give the scene a robot")
        f = 0.7 * width
        self.camera = Camera(f, f, (width - 1) / 2, (3 * width // 4 - 1) / 2, width, 3 * width // 4)
        self.twin, self.robot, self._qpos = twin, robot, twin.follower.qpos
        self._T_scene_base = base_of(twin.scene)
        self._T_world_base = self._T_scene_base if T_world_base is None else T_world_base
        self._T_link_camera = robot.T_link_tcp @ inverse(panda().T_link_tcp) @ T_PANDA_CAMERA
        section = twin.scene.camera
        self._effects = make_effects(section.sensor if section is not None else (), seed=seed, why="wrist camera")
        self._looks = 0

    def look(self) -> DepthView:
        """Implement :meth:`splatbot.grasping.look.WristCamera.look`.

        Raises:
            InputError: the sensor drops ten frames in a row.
        """
        world, data = self.twin.world, self.twin.data
        mujoco.mj_forward(world.model, data)
        T_base_camera = self.robot.fk(np.array(data.qpos[self._qpos]))[-1] @ self._T_link_camera
        geoms, depth = cast(world.model, data, pixel_rays(self.camera), self._T_scene_base @ T_base_camera, _RANGE)
        shown = (depth > 0) & ~world.of_robot[geoms]
        rgb = np.where(shown[..., None], 255.0 * np.asarray(world.model.geom_rgba)[geoms, :3], 0.0).astype(np.uint8)
        own = np.where(shown, depth, 0.0).astype(np.float32)
        for _ in range(_TRIES):
            self._looks += 1
            frame = Frame(float(self._looks), rgb, own, self.camera, self._looks, source=f"wrist#{self._looks}")
            for found in self._effects.over([frame]):
                return np.where(shown, found.depth, 0.0), self.camera, self._T_world_base @ T_base_camera
        raise InputError(f"drops {_TRIES} frames in a row.", field=self.twin.scene.name, hint="lower the share")

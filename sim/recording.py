"""What a twin's run looked like, moment by moment: poses, touches, room."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from splatbot.protocols import Array
from splatbot.sim.contact_monitor import FAR, Near, Room
from splatbot.sim.world import World

RATE = 30.0  # moments a second
_FORCE = 0.05  # [N]; a touch that is fainter is not shown


class TwinRecording:
    """Takes note of a run; handed to :meth:`splatbot.sim.twin.Twin.follow` as ``watch``.

    ``times`` (T,) [s], ``poses`` (T, B, 3, 4) of all of MuJoCo's bodies, ``rooms`` (T,) [m] around the arm, ``touches``
    of each moment: places (3,) [m] and normal forces [N] of the arm's contacts, ``soft`` (T, V, 3) of soft bodies.
    """

    def __init__(self, world: World) -> None:
        self.world = world
        self.times: list[float] = []
        self.rooms: list[float] = []
        self.touches: list[list[tuple[float, float, float, float]]] = []
        self._poses: list[Array] = []
        self._soft: list[Array] = []
        self._room = Room(world)
        self._force = np.zeros(6)

    def __call__(self, data: Any, time: float) -> None:
        """Take note if it is time."""
        if time * RATE < len(self.times):
            return
        self.times.append(time)
        turned = np.array(data.xmat).reshape(-1, 3, 3)
        self._poses.append(np.concatenate([turned, np.array(data.xpos)[:, :, None]], axis=-1))
        self._soft.append(np.array(data.flexvert_xpos).reshape(-1, 3))
        self._room.least = Near(FAR, time)
        self._room.look(data, time)
        self.rooms.append(self._room.least.room)
        self.touches.append(list(self._touching(data)))

    @property
    def poses(self) -> Array:
        """(T, B, 3, 4): rotation and place of each body in the world."""
        return np.array(self._poses)

    @property
    def soft(self) -> Array:
        """Corners of soft bodies (T, V, 3) [m]."""
        return np.array(self._soft)

    def _touching(self, data: Any) -> Any:
        for i, pair in enumerate(data.contact.geom[: int(data.ncon)]):
            if any(geom >= 0 and self.world.of_robot[geom] for geom in pair):
                mujoco.mj_contactForce(self.world.model, data, i, self._force)
                if self._force[0] > _FORCE:
                    yield (*data.contact.pos[i].tolist(), float(self._force[0]))

"""Recording of a twin's run over time: poses, contacts, clearance."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from splatbot.protocols import Array
from splatbot.sim.contact_monitor import FAR, ClearanceMonitor, Expected, MinimumClearance, expect_none
from splatbot.sim.world import OBJECT, World


@dataclass(frozen=True)
class RecordingConstants:
    """Constants of recordings.

    Args:
        rate: [Hz] samples per second.
        min_force: [N] least force of a contact that is recorded.
    """

    rate: float = 30.0
    min_force: float = 0.05


CONSTANTS = RecordingConstants()


class TwinRecording:
    """Records a run as the ``watch`` callback of :meth:`splatbot.sim.twin.Twin.follow`.

    Args:
        world: the scene.
        expected: contacts that are part of the task.

    Attributes:
        times: (T,) [s].
        poses: (T, B, 3, 4) of all MuJoCo bodies.
        clearances: (T,) of the arm [m].
        contacts: positions (3,) [m] and normal forces [N] of the arm's contacts at each time.
        grips: the same of the contacts that are expected.
        soft: (T, V, 3) vertices of soft bodies [m].
    """

    def __init__(self, world: World, *, expected: Expected = expect_none) -> None:
        self.world, self._expected = world, expected
        self.times: list[float] = []
        self.clearances: list[float] = []
        self.contacts: list[list[tuple[float, float, float, float]]] = []
        self.grips: list[list[tuple[float, float, float, float]]] = []
        self._poses: list[Array] = []
        self._soft: list[Array] = []
        self._monitor = ClearanceMonitor(world)
        self._force = np.zeros(6)

    def __call__(self, data: Any, time: float) -> None:
        """Record the state if the next sample is due."""
        if time * CONSTANTS.rate < len(self.times):
            return
        self.times.append(time)
        turned = np.array(data.xmat).reshape(-1, 3, 3)
        self._poses.append(np.concatenate([turned, np.array(data.xpos)[:, :, None]], axis=-1))
        self._soft.append(np.array(data.flexvert_xpos).reshape(-1, 3))
        self._monitor.minimum = MinimumClearance(FAR, time)
        self._monitor.update(data, time)
        self.clearances.append(self._monitor.minimum.value)
        found = list(self._contacts(data, time))
        self.contacts.append([contact for contact, expected in found if not expected])
        self.grips.append([contact for contact, expected in found if expected])

    @property
    def poses(self) -> Array:
        """Rotation and position (T, B, 3, 4) of each body in the world."""
        return np.array(self._poses)

    @property
    def soft(self) -> Array:
        """Vertices of soft bodies (T, V, 3) [m]."""
        return np.array(self._soft)

    def _contacts(self, data: Any, time: float) -> Iterator[tuple[tuple[float, float, float, float], bool]]:
        """Yield the contacts of the arm, and whether they are expected."""
        for i, pair in enumerate(data.contact.geom[: int(data.ncon)].tolist()):
            of_arm = [geom >= 0 and bool(self.world.of_robot[geom]) for geom in pair]
            if any(of_arm):
                mujoco.mj_contactForce(self.world.model, data, i, self._force)
                if self._force[0] > CONSTANTS.min_force:
                    part, other = (self.world.name_of(geom) for geom in (pair if of_arm[0] else pair[::-1]))
                    x, y, z = data.contact.pos[i].tolist()
                    expected = self._expected(part, other, -float(data.contact.dist[i]), time)
                    yield (x, y, z, float(self._force[0])), expected

    def rise(self, name: str) -> Array:
        """Return the height (T,) [m] by which the centre of mass of an object rose."""
        body = self.world.model.body(OBJECT + name)
        poses = self.poses[:, int(body.id)]
        height = poses[:, 2, :3] @ body.ipos + poses[:, 2, 3]
        return np.asarray(height - height[0])

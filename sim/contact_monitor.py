"""Contacts of the arm with their force and depth, and the clearance of the arm."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from splatbot.sim.world import World

FAR = 0.3  # [m] largest clearance that is computed


@dataclass
class ContactEvent:
    """Contacts between a part of the arm and another body over a run.

    Args:
        part: a link or a finger.
        other: an object, the map, or another link.
        first, last: first and last time of contact [s].
        depth: largest penetration [m].
        force: largest normal force [N].
        steps: control periods with contact.
    """

    part: str
    other: str
    first: float
    last: float
    depth: float
    force: float
    steps: int = 1


@dataclass(frozen=True)
class MinimumClearance:
    """Minimum clearance between the arm and other bodies over a run.

    Args:
        value: [m], negative in penetration; ``FAR`` if it was never less.
        time: [s] of the minimum.
        part, other: the closest bodies.
    """

    value: float
    time: float
    part: str = ""
    other: str = ""


Expected = Callable[[str, str, float, float], bool]
"""Returns whether a contact is part of the task; takes the part of the arm, the other body, depth [m] and time [s]."""


def expect_none(part: str, other: str, depth: float, time: float) -> bool:
    """Expect no contact."""
    return False


class ContactMonitor:
    """Records contacts of the arm.

    Args:
        world: the scene.
        expected: contacts that are not recorded, as those of fingers with the object that they grasp.
    """

    def __init__(self, world: World, *, expected: Expected = expect_none) -> None:
        self._world, self._expected = world, expected
        self._found: dict[tuple[str, str], ContactEvent] = {}
        self._force = np.zeros(6)
        self.tangential = 0.0
        self.steps = 0

    def update(self, data: Any, time: float) -> None:
        """Record the current contacts."""
        count = int(data.ncon)
        if not count:
            return
        self.steps += 1
        pairs = data.contact.geom[:count]
        for i, (a, b) in enumerate(pairs.tolist()):
            mujoco.mj_contactForce(self._world.model, data, i, self._force)
            self.tangential = max(self.tangential, float(np.hypot(self._force[1], self._force[2])))
            arm_a, arm_b = a >= 0 and self._world.of_robot[a], b >= 0 and self._world.of_robot[b]
            if arm_a or arm_b:
                first, second = (a, b) if arm_a else (b, a)
                part, other, depth = (
                    self._world.name_of(first),
                    self._world.name_of(second),
                    -float(data.contact.dist[i]),
                )
                if not self._expected(part, other, depth, time):
                    self._note(part, other, time, depth)

    def _note(self, part: str, other: str, time: float, depth: float) -> None:
        force = float(self._force[0])
        known = self._found.get((part, other))
        if known is None:
            self._found[part, other] = ContactEvent(part, other, time, time, depth, force)
            return
        known.steps += known.last < time
        known.last = time
        known.depth, known.force = max(known.depth, depth), max(known.force, force)

    @property
    def found(self) -> list[ContactEvent]:
        """Contacts in the order of their beginning."""
        return sorted(self._found.values(), key=lambda contact: (contact.first, contact.part, contact.other))


class ClearanceMonitor:
    """Minimum clearance between the arm's moving parts and other bodies, by bounding spheres and MuJoCo's distances.

    Args:
        world: the scene.
        without: names of parts of the arm that are left out, as a hand that has to come close.
    """

    def __init__(self, world: World, *, without: Collection[str] = ()) -> None:
        m = world.model
        moving = np.asarray(m.body_weldid)[np.asarray(m.geom_bodyid)] != 0
        counts = np.array([name not in without for name in world.owner], dtype=np.bool_)
        self._arm = np.flatnonzero(world.of_robot & moving & counts)
        self._rest = np.flatnonzero(~world.of_robot)
        self._planes = np.asarray(m.geom_type)[self._rest] == int(mujoco.mjtGeom.mjGEOM_PLANE)
        excluded = set(world.mounted)
        owner = world.owner
        self._excluded = np.array(
            [[(owner[i], owner[j]) in excluded for j in self._rest] for i in self._arm], dtype=np.bool_
        )
        self._world = world
        self.minimum = MinimumClearance(FAR, 0.0)

    def update(self, data: Any, time: float) -> None:
        """Update the minimum with the current clearance."""
        if not len(self._arm) or not len(self._rest):
            return
        for i, j in self._candidates(data):
            clearance = self._distance(data, i, j)
            if clearance < self.minimum.value:
                self.minimum = MinimumClearance(clearance, time, self._world.owner[i], self._world.owner[j])

    def _candidates(self, data: Any) -> NDArray[np.int64]:
        """Return pairs whose bounding spheres are closer than the minimum so far, closest first."""
        m = self._world.model
        at, radius = np.asarray(data.geom_xpos), np.asarray(m.geom_rbound)
        between = at[self._arm][:, None] - at[self._rest][None]
        gap = np.linalg.norm(between, axis=-1) - radius[self._arm][:, None] - radius[self._rest][None]
        if self._planes.any():
            normals = np.asarray(data.geom_xmat).reshape(-1, 3, 3)[self._rest[self._planes]][:, :, 2]
            heights = np.einsum("apk,pk->ap", between[:, self._planes], normals)
            gap[:, self._planes] = heights - radius[self._arm][:, None]
        rows, columns = np.nonzero((gap < self.minimum.value) & ~self._excluded)
        order = np.argsort(gap[rows, columns], kind="stable")
        return np.stack([self._arm[rows[order]], self._rest[columns[order]]], axis=-1)

    def _distance(self, data: Any, i: int, j: int) -> float:
        return float(mujoco.mj_geomDistance(self._world.model, data, int(i), int(j), self.minimum.value, None))

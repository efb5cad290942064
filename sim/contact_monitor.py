"""What the arm touches, how hard and how deep, and how near it comes to the rest."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from splatbot.sim.world import World

FAR = 0.3  # [m]; more room than this is not told apart


@dataclass
class Touch:
    """A part of the arm against something, over a run.

    Args:
        part: a link or a finger.
        other: an object, the map, or another link.
        first, last: when they touched [s].
        depth: deepest overlap [m].
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
class Near:
    """The least room between the arm and the rest.

    Args:
        room: [m], negative where they overlap; ``FAR`` if it was never less.
        time: [s].
        part, other: which.
    """

    room: float
    time: float
    part: str = ""
    other: str = ""


class ContactMonitor:
    """Gathers contacts of the arm."""

    def __init__(self, world: World) -> None:
        self._world = world
        self._found: dict[tuple[str, str], Touch] = {}
        self._force = np.zeros(6)
        self.tangential = 0.0
        self.steps = 0

    def look(self, data: Any, time: float) -> None:
        """Take note of what touches now."""
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
                self._note(self._name(first), self._name(second), time, -float(data.contact.dist[i]))

    def _name(self, geom: int) -> str:
        return self._world.owner[geom] if geom >= 0 else "soft body"

    def _note(self, part: str, other: str, time: float, depth: float) -> None:
        force = float(self._force[0])
        known = self._found.get((part, other))
        if known is None:
            self._found[part, other] = Touch(part, other, time, time, depth, force)
            return
        known.steps += known.last < time
        known.last = time
        known.depth, known.force = max(known.depth, depth), max(known.force, force)

    @property
    def found(self) -> list[Touch]:
        """In the order in which they began."""
        return sorted(self._found.values(), key=lambda touch: (touch.first, touch.part, touch.other))


class Room:
    """The least room between the arm's moving parts and the rest, by bounding spheres and MuJoCo's distances."""

    def __init__(self, world: World) -> None:
        m = world.model
        moving = np.asarray(m.body_weldid)[np.asarray(m.geom_bodyid)] != 0
        self._arm = np.flatnonzero(world.of_robot & moving)
        self._rest = np.flatnonzero(~world.of_robot)
        self._planes = np.asarray(m.geom_type)[self._rest] == int(mujoco.mjtGeom.mjGEOM_PLANE)
        let = set(world.mounted)
        owner = world.owner
        self._let = np.array([[(owner[i], owner[j]) in let for j in self._rest] for i in self._arm], dtype=np.bool_)
        self._world = world
        self.least = Near(FAR, 0.0)

    def look(self, data: Any, time: float) -> None:
        """Take note if it is nearer than ever."""
        if not len(self._arm) or not len(self._rest):
            return
        for i, j in self._candidates(data):
            room = self._distance(data, i, j)
            if room < self.least.room:
                self.least = Near(room, time, self._world.owner[i], self._world.owner[j])

    def _candidates(self, data: Any) -> NDArray[np.int64]:
        """Pairs whose bounding spheres are nearer than the least room so far, nearest first."""
        m = self._world.model
        at, radius = np.asarray(data.geom_xpos), np.asarray(m.geom_rbound)
        between = at[self._arm][:, None] - at[self._rest][None]
        gap = np.linalg.norm(between, axis=-1) - radius[self._arm][:, None] - radius[self._rest][None]
        if self._planes.any():
            normals = np.asarray(data.geom_xmat).reshape(-1, 3, 3)[self._rest[self._planes]][:, :, 2]
            heights = np.einsum("apk,pk->ap", between[:, self._planes], normals)
            gap[:, self._planes] = heights - radius[self._arm][:, None]
        rows, columns = np.nonzero((gap < self.least.room) & ~self._let)
        order = np.argsort(gap[rows, columns], kind="stable")
        return np.stack([self._arm[rows[order]], self._rest[columns[order]]], axis=-1)

    def _distance(self, data: Any, i: int, j: int) -> float:
        return float(mujoco.mj_geomDistance(self._world.model, data, int(i), int(j), self.least.room, None))

"""Pushing a thing across the table by closed fingers: the task, and policies that differ in height, speed and aim."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatbot.protocols import Array
from splatbot.robots.ik import solve_ik
from splatbot.robots.robot import RobotModel
from splatbot.sim.compare.trials import Attempt
from splatbot.sim.motion import minimum_jerk, motion_from_samples
from splatbot.sim.scene import SceneObject
from splatbot.sim.solids import Capsule, Cylinder, Shape, Sphere, rotation_of
from splatbot.sim.twin import Twin, TwinResult
from splatbot.sim.world import OBJECT

NEAR = 0.03  # [m] from the goal that counts as there
_UPRIGHT = float(np.cos(0.5))  # a thing that leans more has tipped over
_FINGER = 0.0125  # [m], radius of the fingers
_LOWEST = 0.03  # [m] of the tool over the table
_RUN = 0.05  # [m] before contact
_OVER = 0.25  # [m] over the table that the tool comes from
_APPROACH, _DOWN, _REST = 2.0, 1.0, 0.5  # [s]
_RATE = 50.0  # [Hz] of the samples; between them a motion is a cubic


@dataclass(frozen=True, eq=False)
class PushCase:
    """A thing that shall go ``distance`` [m] along ``direction`` (2,), over a table at height 0 in the base's frame.

    Args:
        believed: the thing as the map has it; None: the map does not have it.
        true: its name in the held-out twin.
        direction: (2,) unit vector.
        distance: [m].
        seed: of the held-out physics.
    """

    believed: SceneObject | None
    true: str
    direction: Array
    distance: float
    seed: int = 0


@dataclass(frozen=True, eq=False)
class Push:
    """The task: the thing ends upright within 3 cm of its goal, counted from where it stands in each twin.

    Args:
        cases: what to push.
        map_twin: of the map, whose things are movable.
        held_out: gives the held-out twin of a case.
    """

    cases: Sequence[PushCase]
    map_twin: Twin
    held_out: Callable[[PushCase], Twin]
    name: str = "push"

    def twins(self, case: PushCase) -> tuple[Twin, Twin]:
        """See :class:`splatbot.sim.compare.trials.Task`."""
        return self.map_twin, self.held_out(case)

    def succeeded(self, case: PushCase, twin: Twin, result: TwinResult) -> bool:
        """Whether the thing is where it should be, and upright."""
        name = case.true if twin is not self.map_twin else case.believed.name if case.believed is not None else ""
        things = {thing.name: thing for thing in twin.world.scene.movable}
        if name not in things or result.stopped is not None:
            return False
        body = twin.data.body(OBJECT + name)
        goal = np.asarray(things[name].at)[:2] + case.distance * case.direction
        upright = float(np.asarray(body.xmat)[8]) >= _UPRIGHT
        return bool(upright and np.linalg.norm(np.asarray(body.xpos)[:2] - goal) <= NEAR)


@dataclass(frozen=True, eq=False)
class Pusher:
    """Comes down behind the thing and moves straight.

    Args:
        name: of the policy.
        robot: the arm.
        height: of the tool, as a share of the thing's height.
        speed: mean of the tool's [m/s].
        aside: of the thing's middle that the tool aims [m].
    """

    name: str
    robot: RobotModel
    height: float
    speed: float
    aside: float = 0.0

    def act(self, case: PushCase) -> Attempt | None:
        """The motion; None if the map lacks the thing, or the arm does not get there."""
        if case.believed is None:
            return None
        d = np.append(case.direction, 0.0)
        back, tall = extents(case.believed, d)
        middle = np.asarray(case.believed.at) * [1, 1, 0] + self.aside * np.array([-d[1], d[0], 0.0])
        z = np.array([0.0, 0.0, max(_LOWEST, self.height * tall)])
        begin, end = middle - (back + _FINGER + _RUN) * d + z, middle + (case.distance - back - _FINGER) * d + z
        above = np.array([begin[0], begin[1], _OVER])
        return self._motion(above, begin, end, float(np.arctan2(d[1], d[0])))

    def _motion(self, above: Array, begin: Array, end: Array, yaw: float) -> Attempt | None:
        R = rotation_of((np.pi, 0.0, yaw))
        first = self._reach(R, above, self.robot.home, seeds=32)
        if first is None:
            return None
        stretch = max(float(np.linalg.norm(end - begin)) / self.speed, 2 / _RATE)
        lines = [(above, begin, _DOWN), (begin, end, stretch), (end, end, _REST)]
        t = np.arange(0.0, _APPROACH, 1 / _RATE)
        q = list(minimum_jerk(t, np.array([0.0, _APPROACH]), np.stack([self.robot.home, first]), 0))
        times, now, at = list(t), _APPROACH, first
        for a, b, seconds in lines:
            local = np.linspace(0.0, seconds, max(3, round(seconds * _RATE)), endpoint=False)
            for moment, place in zip(
                local, minimum_jerk(local, np.array([0.0, seconds]), np.stack([a, b]), 0), strict=True
            ):
                found = self._reach(R, place, at, seeds=1)
                if found is None:
                    return None
                at = found
                times.append(now + float(moment))
                q.append(at)
            now += seconds
        motion = motion_from_samples(times, np.array(q))
        return Attempt(replace(motion, opening=np.zeros(len(times))))

    def _reach(self, R: Array, at: Array, near: Array, *, seeds: int) -> Array | None:
        T = np.eye(4)
        T[:3, :3], T[:3, 3] = R, at
        found = solve_ik(self.robot, T, near=near, seeds=seeds).q
        return found[0] if len(found) else None


def push_policies(robot: RobotModel) -> tuple[Pusher, ...]:
    """Six ways to push."""
    return (
        Pusher("low, slow", robot, 0.35, 0.08),
        Pusher("low, fast", robot, 0.35, 0.4),
        Pusher("high, slow", robot, 0.85, 0.08),
        Pusher("high, fast", robot, 0.85, 0.4),
        Pusher("low, slow, 2 cm aside", robot, 0.35, 0.08, 0.02),
        Pusher("low, slow, 4 cm aside", robot, 0.35, 0.08, 0.04),
    )


def extents(thing: SceneObject, direction: Array) -> tuple[float, float]:
    """How far a thing reaches from its middle against ``direction`` (3,), and its top over the table [m]."""
    R = rotation_of(thing.rpy)
    back = max(_support(shape, -direction @ R) for shape in thing.shapes)
    top = max(_support(shape, np.array([0.0, 0.0, 1.0]) @ R) for shape in thing.shapes)
    return back, thing.at[2] + top


def _support(shape: Shape, direction: Array) -> float:
    """How far a shape reaches in a direction (3,) of its object's frame [m] (the support function)."""
    n = direction @ rotation_of(shape.rpy)
    away = float(np.asarray(shape.at) @ direction)
    if shape.kind == "box" or shape.kind == "soft":
        return away + float(np.abs(n) @ np.asarray(shape.size)) / 2
    if isinstance(shape, Sphere):
        return away + shape.radius
    if isinstance(shape, Cylinder | Capsule):
        side = shape.radius * (float(np.hypot(n[0], n[1])) if isinstance(shape, Cylinder) else 1.0)
        return away + side + abs(float(n[2])) * shape.height / 2
    if shape.kind == "ellipsoid":
        return away + float(np.linalg.norm(n * np.asarray(shape.axes)))
    if shape.kind == "mesh" and shape.points:
        return away + shape.scale * float((np.asarray(shape.points) @ n).max())
    return away

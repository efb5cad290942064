"""Pushing a thing across the table by closed fingers: the task, and policies that differ in height, speed and aim."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatbot.planning.ik import solve_ik
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel
from splatbot.sim.compare.trials import PolicyAction
from splatbot.sim.motion import minimum_jerk, motion_from_samples
from splatbot.sim.scene import SceneObject
from splatbot.sim.solids import CapsuleGeom, CylinderGeom, Shape, SphereGeom, rotation_of
from splatbot.sim.twin import Twin, TwinResult
from splatbot.sim.world import OBJECT

NEAR = 0.03  # [m] from the goal that counts as there
_UPRIGHT = float(np.cos(0.5))  # a thing that leans more has tipped over
_TIP = 0.01  # [m] that the fingers' tips are ahead of the tool's frame
_TILT = np.pi / 4  # of the tool from straight down, forwards: the fingers, not the hand, meet the thing
_LOWEST = 0.03  # [m] of the tool over the table
_RUN = 0.05  # [m] before contact
_OVER = 0.25  # [m] over the table that the tool comes from
_APPROACH, _DOWN, _REST = 2.0, 1.0, 0.5  # [s]
_POSTURES = 8  # above the thing that are tried
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
class PushTask:
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

    def failure(self, case: PushCase, twin: Twin, result: TwinResult) -> str:
        """That the thing tipped over, or how far it is from where it should be."""
        name = case.true if twin is not self.map_twin else case.believed.name if case.believed is not None else ""
        things = {thing.name: thing for thing in twin.world.scene.movable}
        if name not in things:
            return "the map lacks it"
        if result.stopped is not None:
            return "; ".join(result.warnings) or "stopped"
        body = twin.data.body(OBJECT + name)
        if float(np.asarray(body.xmat)[8]) < _UPRIGHT:
            return "tipped over"
        went = np.asarray(body.xpos)[:2] - np.asarray(things[name].at)[:2]
        off = went - case.distance * case.direction
        if np.linalg.norm(off) <= NEAR:
            return ""
        along = float(off @ case.direction)
        aside = float(np.linalg.norm(off - along * case.direction))
        return f"{1e3 * abs(along):.0f} mm {'beyond' if along > 0 else 'short'}, {1e3 * aside:.0f} mm aside"


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

    def act(self, case: PushCase) -> PolicyAction | None:
        """The motion; None if the map lacks the thing, or the arm does not get there."""
        if case.believed is None:
            return None
        d = np.append(case.direction, 0.0)
        back, tall = extents(case.believed, d)
        middle = np.asarray(case.believed.at) * [1, 1, 0] + self.aside * np.array([-d[1], d[0], 0.0])
        z = np.array([0.0, 0.0, max(_LOWEST, self.height * tall)])
        begin, end = middle - (back + _TIP + _RUN) * d + z, middle + (case.distance - back - _TIP) * d + z
        above = np.array([begin[0], begin[1], _OVER])
        z_tool = np.sin(_TILT) * d - np.array([0.0, 0.0, np.cos(_TILT)])
        y_tool = np.array([d[1], -d[0], 0.0])  # as at home: the other way round the wrist is near its limits
        return self._motion(above, begin, end, np.stack([np.cross(y_tool, z_tool), y_tool, z_tool], axis=1))

    def _motion(self, above: Array, begin: Array, end: Array, R: Array) -> PolicyAction | None:
        """The first of several postures above the thing from which the whole way is within the joints' limits."""
        stretch = max(float(np.linalg.norm(end - begin)) / self.speed, 2 / _RATE)
        times, places = _way([(above, begin, _DOWN), (begin, end, stretch), (end, end, _REST)])
        for first in solve_ik(self.robot, _pose(R, above), near=self.robot.home).q[:_POSTURES]:
            q = self._along(first, places, R)
            if q is not None:
                t = np.arange(0.0, _APPROACH, 1 / _RATE)
                approach = minimum_jerk(t, np.array([0.0, _APPROACH]), np.stack([self.robot.home, first]), 0)
                motion = motion_from_samples(np.append(t, _APPROACH + times), np.concatenate([approach, q]))
                return PolicyAction(replace(motion, opening=np.zeros(len(motion.time))))
        return None

    def _along(self, first: Array, places: Array, R: Array) -> Array | None:
        found = [first]
        for place in places:
            nearest = solve_ik(self.robot, _pose(R, place), near=found[-1], seeds=1).q
            if not len(nearest):
                return None
            found.append(nearest[0])
        return np.array(found[1:])


def _way(lines: Sequence[tuple[Array, Array, float]]) -> tuple[Array, Array]:
    """Times (N,) [s] and places (N, 3) on lines (from, to, seconds), at rest at the end of each."""
    times, places, now = [], [], 0.0
    for a, b, seconds in lines:
        t = np.linspace(0.0, seconds, max(3, round(seconds * _RATE)), endpoint=False)
        times.append(now + t)
        places.append(minimum_jerk(t, np.array([0.0, seconds]), np.stack([a, b]), 0))
        now += seconds
    return np.concatenate(times), np.concatenate(places)


def _pose(R: Array, at: Array) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, at
    return T


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
    if isinstance(shape, SphereGeom):
        return away + shape.radius
    if isinstance(shape, CylinderGeom | CapsuleGeom):
        side = shape.radius * (float(np.hypot(n[0], n[1])) if isinstance(shape, CylinderGeom) else 1.0)
        return away + side + abs(float(n[2])) * shape.height / 2
    if shape.kind == "ellipsoid":
        return away + float(np.linalg.norm(n * np.asarray(shape.axes)))
    if shape.kind == "mesh" and shape.points:
        return away + shape.scale * float((np.asarray(shape.points) @ n).max())
    return away

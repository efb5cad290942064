"""Pushing an object across the table with closed fingers: the task, and policies."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from splatbot.planning.ik import solve_ik
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel
from splatbot.sim.compare.trials import MapTask, PolicyAction
from splatbot.sim.motion import minimum_jerk, motion_from_samples
from splatbot.sim.scene import SceneObject
from splatbot.sim.solids import CapsuleGeom, CylinderGeom, Shape, SphereGeom, rotation_of
from splatbot.sim.twin import Twin, TwinResult
from splatbot.sim.world import OBJECT


@dataclass(frozen=True)
class PushConstants:
    """Constants of pushes."""

    goal_radius: float = 0.03
    """Distance [m] from the goal within which the task succeeds."""
    upright_cosine: float = float(np.cos(0.5))
    """Cosine [1] of the angle from the vertical beyond which an object has tipped over: 0.5 rad."""
    tip: float = 0.01
    """Distance [m] from the tool frame to the finger tips. A wrong one ends the push short of the goal or beyond it."""
    tilt: float = np.pi / 4
    """Tilt [rad] of the tool from straight down. With a smaller one the hand makes contact instead of the fingers."""
    min_height: float = 0.03
    """Smallest height [m] of the tool over the table. A smaller one scrapes along it."""
    run_up: float = 0.05
    """Distance [m] before contact. The arm reaches its speed within it."""
    start_height: float = 0.25
    """Height [m] of the start over the table, above all objects."""
    approach: float = 2.0
    """Time [s] from the home posture to the start."""
    descent: float = 1.0
    """Time [s] of the descent behind the object."""
    rest: float = 0.5
    """Time [s] at rest after the push, in which the object comes to rest, too."""
    max_postures: int = 8
    """Number of postures [1] above the object that are tried. More of them find a path where the first is near its
    limits, and take longer."""
    rate: float = 50.0
    """Rate [Hz] of the samples of the motion. Between them it is a cubic; a smaller one leaves the straight line by
    more."""


CONSTANTS = PushConstants()


@dataclass(frozen=True, eq=False)
class PushCase:
    """An object to be moved by ``distance`` [m] along ``direction`` (2,), on a table at height 0 in the base frame.

    Args:
        believed: the object as in the map. If None, the map lacks it.
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
class PushTask(MapTask[PushCase]):
    """The task: the object ends upright within 3 cm of its goal, relative to its start in each twin.

    :class:`splatbot.sim.compare.trials.MapTask` describes the fields.
    """

    name: str = "push"

    def failure(self, case: PushCase, twin: Twin, result: TwinResult) -> str:
        """Return that the object tipped over, or its distance from the goal; empty after success."""
        name = case.true if twin is not self.map_twin else case.believed.name if case.believed is not None else ""
        objects = {obj.name: obj for obj in twin.world.scene.movable}
        if name not in objects:
            return "the map lacks it"
        if result.stopped is not None:
            return "; ".join(result.warnings) or "stopped"
        body = twin.data.body(OBJECT + name)
        if float(np.asarray(body.xmat)[8]) < CONSTANTS.upright_cosine:
            return "tipped over"
        moved = np.asarray(body.xpos)[:2] - np.asarray(objects[name].at)[:2]
        error = moved - case.distance * case.direction
        if np.linalg.norm(error) <= CONSTANTS.goal_radius:
            return ""
        along = float(error @ case.direction)
        lateral = float(np.linalg.norm(error - along * case.direction))
        return f"{1e3 * abs(along):.0f} mm {'beyond' if along > 0 else 'short'}, {1e3 * lateral:.0f} mm lateral"


@dataclass(frozen=True, eq=False)
class Pusher:
    """Policy that descends behind the object and pushes along a straight line.

    Args:
        name: of the policy.
        robot: the arm.
        height: of the tool, as a fraction of the object's height.
        speed: mean tool speed [m/s].
        offset: lateral distance [m] of the push line from the object's centre.
    """

    name: str
    robot: RobotModel
    height: float
    speed: float
    offset: float = 0.0

    def act(self, case: PushCase) -> PolicyAction | None:
        """Return the motion, or None if the map lacks the object or the arm cannot reach."""
        if case.believed is None:
            return None
        d = np.append(case.direction, 0.0)
        back, tall = extents(case.believed, d)
        middle = np.asarray(case.believed.at) * [1, 1, 0] + self.offset * np.array([-d[1], d[0], 0.0])
        z = np.array([0.0, 0.0, max(CONSTANTS.min_height, self.height * tall)])
        begin, end = (
            middle - (back + CONSTANTS.tip + CONSTANTS.run_up) * d + z,
            middle + (case.distance - back - CONSTANTS.tip) * d + z,
        )
        above = np.array([begin[0], begin[1], CONSTANTS.start_height])
        z_tool = np.sin(CONSTANTS.tilt) * d - np.array([0.0, 0.0, np.cos(CONSTANTS.tilt)])
        y_tool = np.array([d[1], -d[0], 0.0])  # as at home: the opposite sign is near the wrist's limits
        return self._motion(above, begin, end, np.stack([np.cross(y_tool, z_tool), y_tool, z_tool], axis=1))

    def _motion(self, above: Array, begin: Array, end: Array, R: Array) -> PolicyAction | None:
        """Return the motion from the first posture above the object whose whole path is within the joint limits."""
        stretch = max(float(np.linalg.norm(end - begin)) / self.speed, 2 / CONSTANTS.rate)
        times, places = _sampled_lines(
            [(above, begin, CONSTANTS.descent), (begin, end, stretch), (end, end, CONSTANTS.rest)]
        )
        for first in solve_ik(self.robot, _pose(R, above), near=self.robot.home).q[: CONSTANTS.max_postures]:
            q = self._along(first, places, R)
            if q is not None:
                t = np.arange(0.0, CONSTANTS.approach, 1 / CONSTANTS.rate)
                approach = minimum_jerk(t, np.array([0.0, CONSTANTS.approach]), np.stack([self.robot.home, first]), 0)
                motion = motion_from_samples(np.append(t, CONSTANTS.approach + times), np.concatenate([approach, q]))
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


def _sampled_lines(lines: Sequence[tuple[Array, Array, float]]) -> tuple[Array, Array]:
    """Sample times (N,) [s] and positions (N, 3) on lines (from, to, seconds), with rest at the end of each."""
    times, places, now = [], [], 0.0
    for a, b, seconds in lines:
        t = np.linspace(0.0, seconds, max(3, round(seconds * CONSTANTS.rate)), endpoint=False)
        times.append(now + t)
        places.append(minimum_jerk(t, np.array([0.0, seconds]), np.stack([a, b]), 0))
        now += seconds
    return np.concatenate(times), np.concatenate(places)


def _pose(R: Array, at: Array) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = R, at
    return T


def push_policies(robot: RobotModel) -> tuple[Pusher, ...]:
    """Return six pushing policies."""
    return (
        Pusher("low, slow", robot, 0.35, 0.08),
        Pusher("low, fast", robot, 0.35, 0.4),
        Pusher("high, slow", robot, 0.85, 0.08),
        Pusher("high, fast", robot, 0.85, 0.4),
        Pusher("low, slow, 2 cm offset", robot, 0.35, 0.08, 0.02),
        Pusher("low, slow, 4 cm offset", robot, 0.35, 0.08, 0.04),
    )


def extents(obj: SceneObject, direction: Array) -> tuple[float, float]:
    """Compute the extent [m] of an object from its centre against ``direction`` (3,), and its height over the table."""
    R = rotation_of(obj.rpy)
    back = max(_support(shape, -direction @ R) for shape in obj.shapes)
    top = max(_support(shape, np.array([0.0, 0.0, 1.0]) @ R) for shape in obj.shapes)
    return back, obj.at[2] + top


def _support(shape: Shape, direction: Array) -> float:
    """Evaluate the support function of a shape [m] in a direction (3,) of its object's frame."""
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

"""Motions of the arm: joints over time, from a trajectory, a file or the moves of a scene."""

from __future__ import annotations

import csv
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import ArrayLike

from splatbot.collision import RobotSpheres
from splatbot.errors import FormatError, InputError
from splatbot.planning.ik import solve_ik
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel
from splatbot.sim.scene import Scene
from splatbot.sim.solids import rotation_of

_RATE = 250.0  # [Hz] at which moves are sampled; between samples a motion is a cubic
MINIMUM_JERK_PEAK = 15 / 8
"""Ratio [1] of the peak to the mean speed of a minimum-jerk motion: 30 u² (1 - u)² at u = 1/2."""


class Samples(Protocol):
    """States at times (N,)."""

    time: Any
    position: Any
    velocity: Any
    acceleration: Any


class Sampled(Protocol):
    """A trajectory that can be sampled, as the planner's is."""

    def sampled(self, rate: float = ...) -> Any:
        """Sample the trajectory at a rate [Hz]; see :class:`Samples`."""
        ...


@dataclass(frozen=True, eq=False)
class JointMotion:
    """Samples of a motion.

    Args:
        time: (N,) [s], increasing from 0; N >= 2.
        position: (N, J) [rad or m].
        velocity: (N, J), per s.
        acceleration: (N, J), per s².
        opening: (N,) of the gripper [m]. If None, it does not change.

    Raises:
        InputError: shapes do not match, a value is not finite, or times do not increase from 0.
    """

    time: Array
    position: Array
    velocity: Array
    acceleration: Array
    opening: Array | None = None

    def __post_init__(self) -> None:
        n = len(self.time)
        columns = (self.position, self.velocity, self.acceleration)
        if n < 2 or any(c.ndim != 2 or c.shape != self.position.shape or len(c) != n for c in columns):
            raise InputError(
                "has columns of different lengths.", field="motion", hint="give (N,) times and (N, J) each"
            )
        if not all(np.isfinite(c).all() for c in (self.time, *columns)):
            raise InputError("has values that are not finite.", field="motion", hint="give radians, metres and seconds")
        if self.time[0] != 0 or np.any(np.diff(self.time) <= 0):
            raise InputError("has times that do not increase from 0.", field="motion.time", hint="begin at 0, in order")

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(self.time[-1])

    def at(self, t: ArrayLike) -> tuple[Array, Array, Array, Array | None]:
        """Return position, velocity, acceleration (T, J) and opening (T,) at times (T,) [s]; at rest outside.

        Positions are cubic Hermite interpolants of positions and velocities.
        """
        x = np.clip(np.asarray(t, dtype=np.float64), 0.0, self.duration)
        inside = ((np.asarray(t) >= 0) & (np.asarray(t) <= self.duration))[:, None]
        i = np.clip(np.searchsorted(self.time, x, side="right") - 1, 0, len(self.time) - 2)
        h = (self.time[i + 1] - self.time[i])[:, None]
        u = (x - self.time[i])[:, None] / h
        q0, q1, v0, v1 = self.position[i], self.position[i + 1], self.velocity[i] * h, self.velocity[i + 1] * h
        q = q0 + u * (v0 + u * (3 * (q1 - q0) - 2 * v0 - v1 + u * (2 * (q0 - q1) + v0 + v1)))
        v = np.where(inside, (1 - u) * self.velocity[i] + u * self.velocity[i + 1], 0.0)
        a = np.where(inside, (1 - u) * self.acceleration[i] + u * self.acceleration[i + 1], 0.0)
        return q, v, a, None if self.opening is None else np.interp(x, self.time, self.opening)


def motion_from_samples(time: ArrayLike, position: ArrayLike, velocity: ArrayLike | None = None) -> JointMotion:
    """Create a motion through positions (N, J) at times (N,) [s]; missing velocities are central differences."""
    t, q = np.asarray(time, dtype=np.float64), np.asarray(position, dtype=np.float64)
    if t.ndim != 1 or len(t) < 2 or q.ndim != 2 or len(q) != len(t):
        raise InputError(f"are {q.shape} at {t.shape} times.", field="position", hint="give (N, J) at (N,), N >= 2")
    if not np.all(np.diff(t) > 0):
        raise InputError("has times that do not increase from 0.", field="motion.time", hint="begin at 0, in order")
    v = np.gradient(q, t, axis=0) if velocity is None else np.asarray(velocity, dtype=np.float64)
    return JointMotion(t, q, v, np.gradient(v, t, axis=0))


def motion_from_trajectory(trajectory: Sampled, rate: float = 1000.0) -> JointMotion:
    """Sample a planner's trajectory."""
    s: Samples = trajectory.sampled(rate)
    return JointMotion(np.asarray(s.time), np.asarray(s.position), np.asarray(s.velocity), np.asarray(s.acceleration))


def hold(q: ArrayLike, seconds: float) -> JointMotion:
    """Create a motion at rest at a configuration (J,)."""
    if not 0 < seconds < np.inf:
        raise InputError(f"is {seconds}.", field="seconds", hint="give a number above 0")
    at = np.tile(np.asarray(q, dtype=np.float64), (2, 1))
    return JointMotion(np.array([0.0, seconds]), at, np.zeros_like(at), np.zeros_like(at))


def motion_of(scene: Scene, robot: RobotModel, *, seconds: float = 1.0) -> JointMotion:
    """Create the motion of a scene's task: minimum jerk between moves, at rest at each; without moves, a hold at home.

    Raises:
        InputError: a pose cannot be reached.
    """
    start = home_of(scene, robot)
    if not scene.task.moves:
        return hold(start, seconds)
    opened = 2 * robot.gripper.stroke if robot.gripper is not None else 0.0
    times, knots, openings = [0.0], [start], [opened]
    for move in scene.task.moves:
        times.append(move.t)
        knots.append(
            _reach(scene, robot, move.tcp, move.rpy, knots[-1]) if move.tcp else _joints(robot, move, knots[-1])
        )
        openings.append(openings[-1] if move.opening is None else move.opening)
    t = np.unique(np.concatenate([np.arange(0.0, times[-1], 1 / _RATE), times]))
    q, v, a = (minimum_jerk(t, np.array(times), np.array(knots), order) for order in range(3))
    gripped = minimum_jerk(t, np.array(times), np.array(openings)[:, None], 0)[:, 0]
    return JointMotion(t, q, v, a, gripped if robot.gripper is not None else None)


def minimum_jerk(t: Array, times: Array, knots: Array, order: int) -> Array:
    """Evaluate minimum-jerk quintics (T, J) or a derivative between knots (K, J), with rests (Flash, Hogan 1985)."""
    i = np.clip(np.searchsorted(times, t, side="right") - 1, 0, len(times) - 2)
    h = (times[i + 1] - times[i])[:, None]
    u = (t - times[i])[:, None] / h
    shape = (
        u**3 * (10 - 15 * u + 6 * u**2),
        30 * u**2 * (1 - u) ** 2 / h,
        60 * u * (1 - u) * (1 - 2 * u) / h**2,
    )[order]
    return np.asarray((knots[i] if order == 0 else 0.0) + (knots[i + 1] - knots[i]) * shape)


def home_of(scene: Scene, robot: RobotModel) -> Array:
    """Return the initial configuration (J,) of the arm."""
    home = scene.robot.home if scene.robot is not None and scene.robot.home else robot.home
    return np.asarray(home, dtype=np.float64)


def base_of(scene: Scene) -> Array:
    """Return T_world_base (4, 4) of the scene's robot."""
    T = np.eye(4)
    if scene.robot is not None:
        T[:3, :3] = rotation_of((0.0, 0.0, scene.robot.yaw))
        T[:3, 3] = scene.robot.at
    return T


def _joints(robot: RobotModel, move: Any, before: Array) -> Array:
    if not move.joints:
        return before
    return robot.configurations(move.joints)


def _reach(scene: Scene, robot: RobotModel, at: Sequence[float], rpy: Any, near: Array) -> Array:
    T = np.eye(4)
    T[:3, :3], T[:3, 3] = rotation_of(rpy), at
    arm = RobotSpheres(robot)
    found = solve_ik(
        robot, np.linalg.inv(base_of(scene)) @ T, near=near, free=lambda q: ~arm.check(None, q).in_collision
    )
    if not len(found.q):
        raise InputError(
            f"{tuple(at)} cannot be reached.", field="task.moves.tcp", hint="name a nearer place, or turn rpy"
        )
    return np.asarray(found.q[0])


def load_motion(path: str | Path, robot: RobotModel) -> JointMotion:
    """Load a trajectory: ROS ``JointTrajectory`` JSON, or CSV with `time`, `position.JOINT` and `velocity.JOINT`.

    Raises:
        FormatError: the file cannot be read, or names other joints.
    """
    file = Path(path)
    try:
        text = file.read_text(encoding="utf-8-sig")
        values = _from_json(text, robot) if text.lstrip().startswith("{") else _from_csv(text, robot)
    except OSError as error:
        raise FormatError(f"cannot be read ({error.strerror}).", file=file, hint="check the path") from error
    except (KeyError, TypeError, ValueError, IndexError) as error:
        raise FormatError(
            f"is no trajectory of {robot.name} ({error}).",
            file=file,
            field="trajectory",
            hint="name the robot that it was planned with (`twin --robot`), or write JointTrajectory JSON or CSV with "
            f"time and position.{robot.chain.names[0]} and so on",
        ) from error
    try:
        return motion_from_samples(*values)
    except InputError as error:
        raise FormatError(error.message, file=file, field=error.field, hint=error.hint) from error


def _from_json(text: str, robot: RobotModel) -> tuple[Array, Array, Array | None]:
    values: Mapping[str, Any] = json.loads(text)
    missing = [name for name in robot.chain.names if name not in values["joint_names"]]
    if missing:
        raise ValueError(f"it moves {', '.join(values['joint_names'])}, not {missing[0]}")
    order = [values["joint_names"].index(name) for name in robot.chain.names]
    points = values["points"]
    stamps = [p["time_from_start"]["sec"] + 1e-9 * p["time_from_start"]["nanosec"] for p in points]
    q = np.array([p["positions"] for p in points], dtype=np.float64)[:, order]
    moving = all(p.get("velocities") for p in points)
    v = np.array([p["velocities"] for p in points], dtype=np.float64)[:, order] if moving else None
    return np.array(stamps), q, v


def _from_csv(text: str, robot: RobotModel) -> tuple[Array, Array, Array | None]:
    rows = list(csv.DictReader(text.splitlines()))
    names = robot.chain.names
    if not rows:
        raise ValueError("no rows")
    t = np.array([float(row["time"]) for row in rows])
    q = np.array([[float(row[f"position.{name}"]) for name in names] for row in rows])
    if not rows or f"velocity.{names[0]}" not in rows[0]:
        return t, q, None
    return t, q, np.array([[float(row[f"velocity.{name}"]) for name in names] for row in rows])

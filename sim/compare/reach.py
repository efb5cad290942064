"""Reaching a configuration without contact: the task, and policies from a careful planner to a straight line."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.planning import Certificate, GaussianRRTStar, Path, time_path
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel
from splatbot.sim.compare.trials import MapTask, PolicyAction
from splatbot.sim.motion import motion_from_trajectory
from splatbot.sim.twin import Twin, TwinResult


@dataclass(frozen=True)
class ReachTaskConstants:
    """Constants of reaches."""

    goal_tolerance: float = 0.02
    """Largest error [rad] of every joint at the goal. A smaller one counts the lag of the controller as a failure."""
    budget_ms: float = 10_000.0
    """Budget [ms] of a search. It is ample: iterations end a search, not time, so that equal calls give equal paths."""
    cuts: int = 100
    """Number of random cuts [1] that are tried to shorten a path. More of them give shorter paths that pass obstacles
    more closely."""


CONSTANTS = ReachTaskConstants()


@dataclass(frozen=True, eq=False)
class ReachCase:
    """Start and goal configuration (J,), and the seed of the search."""

    start: Array
    goal: Array
    seed: int = 0


@dataclass(frozen=True, eq=False)
class ReachTask(MapTask[ReachCase]):
    """The task: reach the goal without any contact.

    :class:`splatbot.sim.compare.trials.MapTask` describes the fields.
    """

    name: str = "reach"

    def failure(self, case: ReachCase, twin: Twin, result: TwinResult) -> str:
        """Return the first contact, a failure of the simulation, or the distance from the goal; empty after success."""
        if result.contacts:
            first = result.contacts[0]
            return f"contact of {first.part} with {first.other} at {first.first:.2f} s"
        if result.stopped is not None or twin.follower is None:
            return "; ".join(result.warnings) or "stopped"
        error = float(np.abs(np.asarray(twin.data.qpos)[twin.follower.qpos] - case.goal).max())
        return f"{1e3 * error:.0f} mrad from the goal" if error > CONSTANTS.goal_tolerance else ""


@dataclass(frozen=True, eq=False)
class Planned:
    """Policy that follows a certified path.

    Args:
        name: of the policy.
        planner: with its margin.
        speed: fraction of the joint limits of velocity and acceleration.
        iterations: of the search.
    """

    name: str
    planner: GaussianRRTStar
    speed: float = 1.0
    iterations: int = 1500

    def act(self, case: ReachCase) -> PolicyAction | None:
        """Return the best path found, or None."""
        path = _path(self.planner, case, self.iterations)
        return None if path is None else _timed(self.planner, path, self.speed, certified=True)


@dataclass(frozen=True, eq=False)
class Shortcut:
    """Policy that shortcuts a planned path by edges that are checked at a few configurations only.

    Args:
        name: of the policy.
        planner: of the first path.
        samples: configurations that are checked on each edge, ends included.
        iterations: of the search.
    """

    name: str
    planner: GaussianRRTStar
    samples: int
    iterations: int = 1500

    def act(self, case: ReachCase) -> PolicyAction | None:
        """Return a path whose edges are free at the checked configurations."""
        path = _path(self.planner, case, self.iterations)
        if path is None:
            return None
        rng = np.random.default_rng(case.seed)
        q = path.waypoints
        for _ in range(CONSTANTS.cuts):
            q = self._cut(q, rng)
        return _timed(self.planner, _uncertified(q), 1.0, certified=False)

    def _cut(self, q: Array, rng: np.random.Generator) -> Array:
        """Connect two random positions on the path by an edge if its samples are free."""
        steps = np.linalg.norm(np.diff(q, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        low, high = np.sort(rng.uniform(0.0, along[-1], 2))
        a, b = (np.array([np.interp(s, along, column) for column in q.T]) for s in (low, high))
        arm, field = self.planner.arm, self.planner.field
        if arm.sample(field, a[None], b[None], samples=self.samples).in_collision[0]:
            return q
        before, after = q[along < low], q[along > high]
        return np.concatenate([before, a[None], b[None], after])


@dataclass(frozen=True, eq=False)
class Direct:
    """Policy without a planner: straight to the goal in joint space, or via a posture.

    Args:
        name: of the policy.
        planner: of the arm; its map is not used.
        via: (J,) a posture between start and goal. If None, the motion is straight.
    """

    name: str
    planner: GaussianRRTStar
    via: Array | None = None

    def act(self, case: ReachCase) -> PolicyAction | None:
        """Return the motion; there always is one."""
        stops = [case.start, case.goal] if self.via is None else [case.start, self.via, case.goal]
        return _timed(self.planner, _uncertified(np.array(stops)), 1.0, certified=False)


def reach_policies(
    field: GaussianCollisionField, robot: RobotModel, T_world_base: Array, own_margin: float
) -> tuple[Planned | Shortcut | Direct, ...]:
    """Return eight policies, from the planner with the map's own margin to a straight line.

    Args:
        field: of the map.
        robot: the arm.
        T_world_base: (4, 4).
        own_margin: error [m] of the map's surfaces against its own depth images.
    """
    no_margin = GaussianRRTStar(field, robot, T_world_base=T_world_base)
    small, wide = (GaussianRRTStar(field, robot, T_world_base=T_world_base, margin=m) for m in (0.005, own_margin))
    return (
        Planned("planned, the map's own margin", wide),
        Planned("planned, 5 mm margin", small),
        Planned("planned, no margin", no_margin),
        Planned("planned, no margin, third of the speed", no_margin, speed=1 / 3),
        Shortcut("shortcuts, 8 samples an edge", no_margin, 8),
        Shortcut("shortcuts, ends of an edge only", no_margin, 2),
        Direct("via home", no_margin, robot.home),
        Direct("straight line", no_margin),
    )


def _path(planner: GaussianRRTStar, case: ReachCase, iterations: int) -> Path | None:
    return planner.plan(
        case.start, case.goal, budget_ms=CONSTANTS.budget_ms, seed=case.seed, iterations=iterations
    ).path


def _uncertified(waypoints: Array) -> Path:
    length = float(np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum())
    return Path(waypoints, length, Certificate(False, 1e-3, 0.0, 0.0, -1))


def _timed(planner: GaussianRRTStar, path: Path, speed: float, *, certified: bool) -> PolicyAction:
    """Time-parameterize a path; without ``certified`` the map is not used."""
    arm: RobotSpheres = planner.arm
    field = planner.field if certified else None
    trajectory = time_path(path, arm, field, velocity_scale=speed, acceleration_scale=speed)
    promised = (
        trajectory.certificate.clearance + planner.margin if certified and trajectory.certificate.certified else None
    )
    return PolicyAction(motion_from_trajectory(trajectory), promised)

"""Reaching a configuration among things without touching any: the task, and policies from careful to none at all."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.planning import Certificate, GaussianRRTStar, Path, time_path
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel
from splatbot.sim.compare.trials import PolicyAction
from splatbot.sim.motion import motion_from_trajectory
from splatbot.sim.twin import Twin, TwinResult

_ARRIVED = 0.02  # [rad] from the goal in every joint
_AMPLE_MS = 10_000.0  # iterations end a search, not the time: equal calls give equal paths
_CUTS = 100  # shortcuts that are tried


@dataclass(frozen=True, eq=False)
class ReachCase:
    """From a configuration (J,) to another, with the search's seed."""

    start: Array
    goal: Array
    seed: int = 0


@dataclass(frozen=True, eq=False)
class ReachTask:
    """The task: at the goal in the end, and nothing touched on the way.

    Args:
        cases: what to reach.
        map_twin: of the map; the same for all cases.
        held_out: gives the held-out twin of a case.
    """

    cases: Sequence[ReachCase]
    map_twin: Twin
    held_out: Callable[[ReachCase], Twin]
    name: str = "reach"

    def twins(self, case: ReachCase) -> tuple[Twin, Twin]:
        """See :class:`splatbot.sim.compare.trials.Task`."""
        return self.map_twin, self.held_out(case)

    def failure(self, case: ReachCase, twin: Twin, result: TwinResult) -> str:
        """What was touched, or that physics broke, or that a joint is more than 20 mrad from the goal."""
        if result.touches:
            first = result.touches[0]
            return f"{first.part} touches {first.other} at {first.first:.2f} s"
        if result.stopped is not None or twin.follower is None:
            return "; ".join(result.warnings) or "stopped"
        off = float(np.abs(np.asarray(twin.data.qpos)[twin.follower.qpos] - case.goal).max())
        return f"{1e3 * off:.0f} mrad from the goal" if off > _ARRIVED else ""


@dataclass(frozen=True, eq=False)
class Planned:
    """Certified paths.

    Args:
        name: of the policy.
        planner: with its margin.
        speed: share of the joints' limits of velocity and acceleration.
        iterations: of the search.
    """

    name: str
    planner: GaussianRRTStar
    speed: float = 1.0
    iterations: int = 1500

    def act(self, case: ReachCase) -> PolicyAction | None:
        """The best path found, or none."""
        path = _path(self.planner, case, self.iterations)
        return None if path is None else _timed(self.planner, path, self.speed, certified=True)


@dataclass(frozen=True, eq=False)
class Shortcut:
    """A planned path, cut shorter by edges of which only a few configurations are looked at.

    Args:
        name: of the policy.
        planner: of the first path.
        samples: looked at on each edge, ends included.
        iterations: of the search.
    """

    name: str
    planner: GaussianRRTStar
    samples: int
    iterations: int = 1500

    def act(self, case: ReachCase) -> PolicyAction | None:
        """A path whose edges are free where they were looked at."""
        path = _path(self.planner, case, self.iterations)
        if path is None:
            return None
        rng = np.random.default_rng(case.seed)
        q = path.waypoints
        for _ in range(_CUTS):
            q = self._cut(q, rng)
        return _timed(self.planner, _uncertified(q), 1.0, certified=False)

    def _cut(self, q: Array, rng: np.random.Generator) -> Array:
        """Two places on the path, joined straight if that looks free."""
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
    """No planner: straight to the goal in joint space, or by way of a posture.

    Args:
        name: of the policy.
        planner: whose arm it is; its map is not asked.
        via: (J,) a posture on the way; None: none.
    """

    name: str
    planner: GaussianRRTStar
    via: Array | None = None

    def act(self, case: ReachCase) -> PolicyAction | None:
        """Always something."""
        stops = [case.start, case.goal] if self.via is None else [case.start, self.via, case.goal]
        return _timed(self.planner, _uncertified(np.array(stops)), 1.0, certified=False)


def reach_policies(
    field: GaussianCollisionField, robot: RobotModel, T_world_base: Array, own_margin: float
) -> tuple[Planned | Shortcut | Direct, ...]:
    """Eight policies, from the planner with the map's own margin to a straight line.

    Args:
        field: the map.
        robot: the arm.
        T_world_base: (4, 4).
        own_margin: the error of the map's surfaces, as its own depth tells [m].
    """
    bare = GaussianRRTStar(field, robot, T_world_base=T_world_base)
    little, wide = (GaussianRRTStar(field, robot, T_world_base=T_world_base, margin=m) for m in (0.005, own_margin))
    return (
        Planned("planned, the map's own margin", wide),
        Planned("planned, 5 mm margin", little),
        Planned("planned, no margin", bare),
        Planned("planned, no margin, third of the speed", bare, speed=1 / 3),
        Shortcut("shortcuts, 8 samples an edge", bare, 8),
        Shortcut("shortcuts, ends of an edge only", bare, 2),
        Direct("by way of home", bare, robot.home),
        Direct("straight line", bare),
    )


def _path(planner: GaussianRRTStar, case: ReachCase, iterations: int) -> Path | None:
    return planner.plan(case.start, case.goal, budget_ms=_AMPLE_MS, seed=case.seed, iterations=iterations).path


def _uncertified(waypoints: Array) -> Path:
    length = float(np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum())
    return Path(waypoints, length, Certificate(False, 1e-3, 0.0, 0.0, -1))


def _timed(planner: GaussianRRTStar, path: Path, speed: float, *, certified: bool) -> PolicyAction:
    """With the map's certificate, or, of a path that was never certified, without asking the map."""
    arm: RobotSpheres = planner.arm
    field = planner.field if certified else None
    trajectory = time_path(path, arm, field, velocity_scale=speed, acceleration_scale=speed)
    promised = (
        trajectory.certificate.clearance + planner.margin if certified and trajectory.certificate.certified else None
    )
    return PolicyAction(motion_from_trajectory(trajectory), promised)

"""Planning with the margin that the audit of a map requires in the region of the motion."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np

from splatbot.collision import RobotSpheres
from splatbot.errors import InputError
from splatbot.planning import GaussianRRTStar, JointTrajectory, Path, PlanResult, time_path
from splatbot.protocols import Array, HasHand
from splatbot.results.margin import AuditedError
from splatbot.results.plan_obstacles import PlanObstacles


@dataclass(frozen=True)
class RegionPlanConstants:
    """Constants of planning with the margin of a region.

    Args:
        rounds: largest number of plans; each has the margin that the path before required, and a little more.
        growth: factor of that margin, so that the rounds end although each path passes other points.
        samples: number of configurations of a trajectory that define its region.
        base_foot: [m] height below which the base may touch the map, on which it stands.
    """

    rounds: int = 8
    growth: float = 1.1
    samples: int = 200
    base_foot: float = 0.03


CONSTANTS = RegionPlanConstants()


@dataclass(frozen=True, eq=False)
class RegionPlan:
    """A plan and the audit of the region of its motion.

    Args:
        planner: the planner with the margin of the plan.
        result: of the last plan.
        trajectory: the timed path; None without a path.
        points: number of confirmed surface points that the margin is from. None if it was given, not audited.
        error: their error [m] at the confidence; the margin is not smaller. None with ``points``.
    """

    planner: GaussianRRTStar
    result: PlanResult
    trajectory: JointTrajectory | None
    points: int | None
    error: float | None

    def scope(self, around: PlanObstacles, *, confidence: float) -> dict[str, Any]:
        """Describe the scope of the certificate: obstacles, unknown space, and the origin of the margin.

        The base is not checked, but ``base_in_map`` says whether more than its foot is in the map.

        Args:
            around: obstacles of the plan.
            confidence: share of the measured surface that an audited margin covers.
        """
        audited, margin, robot = self.points is not None, self.planner.margin, self.planner.arm.robot
        return {
            "map_gaussians": len(around.map_field),
            "n_sigma": around.map_field.n_sigma,
            "self_collision": True,
            "base": False,
            "hand": isinstance(robot, HasHand) and robot.hand is not None,
            "base_in_map": self.planner.arm.base_in_map_above(self.planner.field, CONSTANTS.base_foot),
            "support_plane": around.covers_support,
            "measured_surface": around.covers_measured,
            "unknown_space": around.policy,
            "margin_m": margin,
            "margin_from": "audit" if audited else "user" if margin > 0 else "none",
            "confidence": confidence if audited else None,
            "region_points": self.points,
            "region_error_m": self.error,
        }


def plan_in_region(
    make_planner: Callable[[float], GaussianRRTStar],
    plan: Callable[[GaussianRRTStar], PlanResult],
    ends: Array,
    error: AuditedError,
    *,
    confidence: float,
    speed: float = 1.0,
    acceleration: float | None = None,
) -> RegionPlan:
    """Plan with the audited error of the region of the motion as the margin.

    1. The first margin is the error within 20 cm of the arm at ``ends``. If fewer than 1 / (1 - confidence) points are
       there, the region grows until it has as many.
    2. A plan with this margin gives a trajectory, and its region the error that it requires.
    3. If that is larger than the margin, plan again with 1.1 times the error.

    The margins increase, so that the last margin covers the region of the last trajectory.

    Args:
        make_planner: makes the planner with a margin [m].
        plan: plans with it.
        ends: (E, J) known configurations of the motion, as start and goal [rad or m].
        error: audited error of the map.
        confidence: share of the confirmed surface points that the margin covers, 0..1.
        speed: fraction of the limits of velocity, 0..1.
        acceleration: fraction of the limits of acceleration, 0..1; by default ``speed``.

    Raises:
        InputError: the margins still increase after eight plans, or the confidence is not in 0..1.
    """
    if not 0.0 <= confidence <= 1.0:
        raise InputError(f"is {confidence}.", field="confidence", hint="give a value in 0..1, as 0.999")
    margin = _around(make_planner(0.0).arm, ends, error, confidence).quantile(confidence)
    for _ in range(CONSTANTS.rounds):
        planner = make_planner(margin)
        result = plan(planner)
        if result.path is None:
            return RegionPlan(planner, result, None, 0, margin)
        trajectory = _timed(planner, result.path, speed, acceleration)
        moments = np.linspace(0.0, trajectory.duration, CONSTANTS.samples)
        region = _around(planner.arm, trajectory.at(moments).position, error, confidence)
        required = region.quantile(confidence)
        if required <= margin:
            return RegionPlan(planner, result, trajectory, len(region), required)
        margin = CONSTANTS.growth * required
    raise InputError(
        f"is at least {1e3 * margin:.1f} mm, and each path through it requires more.",
        field="margin",
        hint="give the margin in metres, or a lower confidence",
    )


def plan_at_margin(
    planner: GaussianRRTStar,
    plan: Callable[[GaussianRRTStar], PlanResult],
    *,
    speed: float,
    acceleration: float | None = None,
) -> RegionPlan:
    """Plan with the margin that was given, without an audit; see :func:`plan_in_region` for the arguments."""
    result = plan(planner)
    trajectory = None if result.path is None else _timed(planner, result.path, speed, acceleration)
    return RegionPlan(planner, result, trajectory, points=None, error=None)


def _timed(planner: GaussianRRTStar, path: Path, speed: float, acceleration: float | None) -> JointTrajectory:
    """Time a path with fractions of the limits of velocity and acceleration."""
    scale = speed if acceleration is None else acceleration
    return time_path(path, planner.arm, planner.field, velocity_scale=speed, acceleration_scale=scale)


def _around(arm: RobotSpheres, q: Array, error: AuditedError, confidence: float) -> AuditedError:
    """Return the points near the arm, at least as many as the confidence needs."""
    return error.in_region(arm.centers(np.atleast_2d(q)).reshape(-1, 3), confidence)

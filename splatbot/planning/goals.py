"""Goal configurations: the valid ones of a given set, or postures that place the tool at a pose."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.geometry import so3_exp
from splatbot.planning.causes import collision, limit_violation
from splatbot.planning.ik import CONSTANTS as IK
from splatbot.planning.ik import HasTool, inverse_kinematics, is_rigid, nearest_turns
from splatbot.planning.problem import Cause, Goal, GoalError, JointGoal, PlanStatus, PoseGoal
from splatbot.protocols import Array


@dataclass(frozen=True)
class GoalConstants:
    """Constants of the search for goal postures."""

    batch: int = 16
    """Number of starts [1] between two readings of the clock. A larger one exceeds the budget by more, a smaller one
    uses the vector units less."""
    min_starts: int = 128
    """Smallest number of starts [1] before the search for a first posture may time out. A larger one finds rare
    postures and may exceed a short budget."""
    min_separation: float = 0.05
    """Largest difference [rad or m] of every joint of two postures that count as one. A larger one returns fewer
    postures."""
    ranking_cut: float = 0.1
    """Clearance [m] above which postures rank equally. A larger one takes longer to compute."""
    max_causes: int = 8
    """Largest number of rejected postures [1] that are examined for the cause of a failure. The one with the least
    penetration is reported."""


CONSTANTS = GoalConstants()


@dataclass(frozen=True, eq=False)
class Goals:
    """Valid goal configurations, or the reason why none exists.

    Args:
        q: (K, J) [rad or m], those of a pose sorted by clearance, largest first.
        status: SUCCESS, or the failure.
        cause: collision or limit violation, if known.
        reason: one sentence; empty on success.
    """

    q: Array
    status: PlanStatus = PlanStatus.SUCCESS
    cause: Cause | None = None
    reason: str = ""


def goal_configurations(
    arm: RobotSpheres, field: GaussianCollisionField, goal: Goal | ArrayLike, *, near: Array, seed: int, until: float
) -> Goals:
    """Return the goal configurations that are within limits and free of collisions.

    Args:
        arm: the robot.
        field: the map.
        goal: see :mod:`splatbot.planning.problem`.
        near: (J,) first start of the inverse kinematics, whose full turns the postures of a pose share [rad or m].
        seed: seed of the random starts.
        until: time of ``time.perf_counter`` at which the search for further postures ends [s].

    Raises:
        GoalError: the goal has a wrong shape, is not finite, or needs a tool that the robot lacks.
    """
    if isinstance(goal, PoseGoal):
        return _postures(arm, field, goal, near, seed, until)
    q = _configurations(goal.q if isinstance(goal, JointGoal) else goal, len(arm.robot.chain))
    chain = arm.robot.chain
    causes = [limit_violation(chain, candidate) for candidate in q]
    inside = np.array([cause is None for cause in causes])
    if not inside.any():
        return Goals(q[:0], PlanStatus.GOAL_STATE_INVALID, causes[0], f"{causes[0]}.")
    return _free(arm, field, q[inside])


def _configurations(values: ArrayLike, joints: int) -> Array:
    try:
        q = np.atleast_2d(np.ascontiguousarray(values, dtype=np.float64))
    except (TypeError, ValueError) as error:
        raise GoalError(f"is no row of numbers ({error}).", field="goal") from error
    if q.ndim != 2 or q.shape[1] != joints or not len(q):
        raise GoalError(f"is {q.shape}.", field="goal", hint=f"give (K, {joints}) joint values, or a PoseGoal")
    if not np.isfinite(q).all():
        row = int(np.argmax(~np.isfinite(q).all(axis=1)))
        raise GoalError(f"row {row} is not finite.", field="goal", hint="give radians and metres")
    return q


def _free(arm: RobotSpheres, field: GaussianCollisionField, q: Array) -> Goals:
    """Return the configurations of (K, J) that are free of collisions."""
    free = ~arm.check(field, q).in_collision
    if free.any():
        return Goals(np.ascontiguousarray(q[free]))
    causes = [collision(arm, field, candidate) for candidate in q[: CONSTANTS.max_causes]]
    least = min(causes, key=lambda cause: cause.depth)
    return Goals(q[:0], PlanStatus.GOAL_IN_COLLISION, least, f"{least}.")


def _postures(
    arm: RobotSpheres, field: GaussianCollisionField, goal: PoseGoal, near: Array, seed: int, until: float
) -> Goals:
    robot, chain = arm.robot, arm.robot.chain
    if not isinstance(robot, HasTool):
        raise GoalError("is a pose.", field="goal", hint=f"{robot.name} has no tool: give joint values")
    T, box = _region(goal)
    rng = np.random.default_rng(seed)
    found: list[Array] = []
    reached, least_error = False, np.array([np.inf, np.inf])
    colliding: list[Array] = []
    for tried in range(0, IK.max_starts, CONSTANTS.batch):
        starts = rng.uniform(chain.lower, chain.upper, (CONSTANTS.batch, len(chain)))
        offsets = rng.uniform(-1.0, 1.0, (CONSTANTS.batch, 6)) * box
        if tried == 0:
            starts[0], offsets[0] = near, 0.0
        q, error = _solve(arm, robot.T_link_tcp, T, offsets, starts)
        q = nearest_turns(q, near, chain)
        converged = (error <= IK.max_error).all(axis=1)
        if converged.any():
            free = ~arm.check(field, q).in_collision
            colliding += list(q[converged & ~free][: CONSTANTS.max_causes - len(colliding)])
            for candidate in q[converged & free]:
                if all(np.abs(candidate - other).max() > CONSTANTS.min_separation for other in found):
                    found.append(candidate)
            reached = True
        elif not reached:
            nearest = int(np.argmin(error.sum(axis=1)))
            least_error = error[nearest] if error[nearest].sum() < least_error.sum() else least_error
        if len(found) >= goal.postures or (time.perf_counter() >= until and (found or tried >= CONSTANTS.min_starts)):
            break
    if found:
        q = np.array(found[: goal.postures])
        clearance = np.minimum(arm.clearance(field, q, cut=CONSTANTS.ranking_cut).distance, CONSTANTS.ranking_cut)
        return Goals(np.ascontiguousarray(q[np.argsort(-clearance, kind="stable")]))
    if reached:
        return _free(arm, field, np.array(colliding))
    distance, angle = least_error
    reason = f"no posture reaches the pose: the nearest misses it by {1e3 * distance:.1f} mm and {angle:.3f} rad."
    return Goals(np.zeros((0, len(chain))), PlanStatus.NO_IK_SOLUTION, None, reason)


def _solve(arm: RobotSpheres, tool: Array, T: Array, offsets: Array, starts: Array) -> tuple[Array, Array]:
    """Return joint values (S, J) and errors (S, 2) for poses with offsets (S, 6) = (translation, rotation vector)."""
    targets = np.tile(T, (len(starts), 1, 1))
    targets[:, :3, 3] += offsets[:, :3] @ T[:3, :3].T
    targets[:, :3, :3] = T[:3, :3] @ np.stack([so3_exp(turn) for turn in offsets[:, 3:]])
    return inverse_kinematics(arm.native, arm.robot.chain, tool, targets, starts)


def _region(goal: PoseGoal) -> tuple[Array, Array]:
    """Return the pose (4, 4) and the half-widths (6,) of the region around it."""
    T = np.asarray(goal.T_world_tcp, dtype=np.float64)
    if not is_rigid(T):
        raise GoalError("is no rigid pose.", field="T_world_tcp", hint="give (4, 4) with an orthonormal rotation")
    box = np.concatenate([np.broadcast_to(np.asarray(x, dtype=np.float64), (3,)) for x in (goal.position, goal.angle)])
    if not ((box >= 0.0) & (box < np.inf)).all() or goal.postures < 1:
        raise GoalError(
            "has a negative or infinite width, or a number of postures below 1.",
            field="goal",
            hint="give metres, radians and a number of postures above 0",
        )
    return T, box

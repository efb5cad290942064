"""Goals as configurations: those of a set that will do, or postures that reach a pose."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.geometry import so3_exp
from splatbot.planning.causes import beyond_limits, collision
from splatbot.planning.ik import MAX_STARTS, TOLERANCE, HasTool, inverse_kinematics, is_rigid
from splatbot.planning.problem import Cause, Goal, GoalError, JointGoal, PlanStatus, PoseGoal
from splatbot.protocols import Array

_BATCH = 16  # starts between two looks at the clock
_FEWEST = 128  # before a pose is given up
_APART = 0.05  # [rad or m]; postures nearer than this in every joint are one


@dataclass(frozen=True, eq=False)
class Goals:
    """Configurations (K, J) that will do, most room first; without any, why."""

    q: Array
    status: PlanStatus = PlanStatus.SUCCESS
    cause: Cause | None = None
    reason: str = ""


def goal_configurations(
    arm: RobotSpheres, field: GaussianCollisionField, goal: Goal | ArrayLike, *, near: Array, seed: int, until: float
) -> Goals:
    """The goal's configurations that are within limits and free.

    Args:
        arm: the robot.
        field: the map.
        goal: see :mod:`splatbot.planning.problem`.
        near: (J,) where the search for postures starts first.
        seed: of the other starts.
        until: of ``time.perf_counter``, when to stop looking for more postures.

    Raises:
        GoalError: the goal is of another shape, not finite, or needs a tool that the robot has not.
    """
    if isinstance(goal, PoseGoal):
        return _postures(arm, field, goal, near, seed, until)
    q = _configurations(goal.q if isinstance(goal, JointGoal) else goal, len(arm.robot.chain))
    chain = arm.robot.chain
    causes = [beyond_limits(chain, one) for one in q]
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
    """Those of configurations (K, J) that touch nothing."""
    free = ~arm.check(field, q).in_collision
    if free.any():
        return Goals(np.ascontiguousarray(q[free]))
    causes = [collision(arm, field, one) for one in q[:8]]
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
    reached, missed = False, np.array([np.inf, np.inf])
    hit: list[Array] = []
    for tried in range(0, MAX_STARTS, _BATCH):
        starts = rng.uniform(chain.lower, chain.upper, (_BATCH, len(chain)))
        offsets = rng.uniform(-1.0, 1.0, (_BATCH, 6)) * box
        if tried == 0:
            starts[0], offsets[0] = near, 0.0
        q, miss = _solve(arm, robot.T_link_tcp, T, offsets, starts)
        good = (miss <= TOLERANCE).all(axis=1)
        if good.any():
            free = ~arm.check(field, q).in_collision
            hit += list(q[good & ~free][: 8 - len(hit)])
            for one in q[good & free]:
                if all(np.abs(one - other).max() > _APART for other in found):
                    found.append(one)
            reached = True
        elif not reached:
            nearest = int(np.argmin(miss.sum(axis=1)))
            missed = miss[nearest] if miss[nearest].sum() < missed.sum() else missed
        if len(found) >= goal.postures or (time.perf_counter() >= until and (found or tried >= _FEWEST)):
            break
    if found:
        q = np.array(found[: goal.postures])
        room = arm.clearance(field, q, cut=0.1).distance
        return Goals(np.ascontiguousarray(q[np.argsort(-np.minimum(room, 0.1), kind="stable")]))
    if reached:
        return _free(arm, field, np.array(hit))
    why = f"no posture reaches the pose: the nearest misses it by {1e3 * missed[0]:.1f} mm and {missed[1]:.3f} rad."
    return Goals(np.zeros((0, len(chain))), PlanStatus.NO_IK_SOLUTION, None, why)


def _solve(arm: RobotSpheres, tool: Array, T: Array, offsets: Array, starts: Array) -> tuple[Array, Array]:
    """Joint values (S, J) for the pose moved by offsets (S, 6) = (translation, rotation vector), and what they miss."""
    targets = np.tile(T, (len(starts), 1, 1))
    targets[:, :3, 3] += offsets[:, :3] @ T[:3, :3].T
    targets[:, :3, :3] = T[:3, :3] @ np.stack([so3_exp(turn) for turn in offsets[:, 3:]])
    return inverse_kinematics(arm.native, arm.robot.chain, tool, targets, starts)


def _region(goal: PoseGoal) -> tuple[Array, Array]:
    """The pose (4, 4) and the half-widths (6,) of the region around it."""
    T = np.asarray(goal.T_world_tcp, dtype=np.float64)
    if not is_rigid(T):
        raise GoalError("is no rigid pose.", field="T_world_tcp", hint="give (4, 4) with an orthonormal rotation")
    box = np.concatenate([np.broadcast_to(np.asarray(x, dtype=np.float64), (3,)) for x in (goal.position, goal.angle)])
    if not ((box >= 0.0) & (box < np.inf)).all() or goal.postures < 1:
        raise GoalError(
            "has a negative width, or no posture is wanted.",
            field="goal",
            hint="give metres, radians and a number of postures above 0",
        )
    return T, box

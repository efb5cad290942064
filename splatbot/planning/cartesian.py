"""Cartesian paths: the tool moves along a straight line, as in the approach to a grasp and the retreat."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.collision.robot import EPS
from splatbot.errors import InputError
from splatbot.geometry import so3_exp, so3_log
from splatbot.planning.causes import collision
from splatbot.planning.ik import CONSTANTS as IK
from splatbot.planning.ik import HasTool, inverse_kinematics, is_rigid
from splatbot.planning.problem import Cause, Certificate, GoalError, Path, PlanStatus, StartError
from splatbot.planning.timing import min_clearance
from splatbot.protocols import Array


@dataclass(frozen=True)
class LineConstants:
    """Constants of straight lines of the tool.

    Args:
        max_step: [m] largest distance between two points of the line.
        max_turn: [rad] largest rotation between two points.
        max_jump: [rad or m] largest step of a joint between two points; a larger one is another branch of the IK.
        max_deviation: [m] largest deviation of the tool from the line between two points.
        max_subdivisions: largest number of times that the points are doubled to keep ``max_deviation``.
    """

    max_step: float = 0.01
    max_turn: float = 0.05
    max_jump: float = 0.3
    max_deviation: float = 1e-3
    max_subdivisions: int = 4


CONSTANTS = LineConstants()


@dataclass(frozen=True, eq=False)
class StraightResult:
    """Result of :func:`straight_line`. True if the path covers the whole line.

    Args:
        status: SUCCESS, NO_IK_SOLUTION, GOAL_IN_COLLISION or START_STATE_IN_COLLISION.
        path: certified part of the line from its start; None if no part is certified.
        share: fraction of the line that the path covers, 0..1.
        off_line: largest deviation of the tool from the line between two points [m].
        cause: the obstacle, if a collision ends the path.
        reason: one sentence that explains an early end; empty on success.
    """

    status: PlanStatus
    path: Path | None
    share: float
    off_line: float
    cause: Cause | None = None
    reason: str = ""

    def __bool__(self) -> bool:
        return self.status is PlanStatus.SUCCESS


def straight_line(
    arm: RobotSpheres,
    field: GaussianCollisionField | None,
    start: ArrayLike,
    T_world_end: ArrayLike,
    *,
    eps: float = EPS,
    off_line: float = CONSTANTS.max_deviation,
) -> StraightResult:
    """Move the tool on a straight line with a constant axis of rotation.

    At a fraction s of the line the tool is at ``p(s) = p0 + s (p1 - p0)``, ``R(s) = R0 exp(s log(R0ᵀ R1))``. Inverse
    kinematics starts at the joint values of the previous point, so that the path stays on one branch. The edges between
    the points are certified over their whole length.

    Args:
        arm: the robot; an attached object is part of its spheres.
        field: the map without the object to grasp. If None, only self-collision is checked.
        start: (J,) configuration [rad or m].
        T_world_end: (4, 4) final pose of the tool [m].
        eps: see :meth:`splatbot.collision.RobotSpheres.certify` [m].
        off_line: largest deviation of the tool from the line [m].

    Raises:
        StartError: the start does not fit the arm.
        GoalError: the end is no rigid pose, or the robot has no tool.
        InputError: ``off_line`` is not above 0.
    """
    q0, T_end, tool = _checked(arm, start, T_world_end, off_line)
    T_start = arm.forward(q0[None])[0, -1] @ tool
    length, turn = T_end[:3, 3] - T_start[:3, 3], so3_log(T_start[:3, :3].T @ T_end[:3, :3])
    if arm.check(field, q0[None]).in_collision[0]:
        cause = collision(arm, field, q0) if field is not None else None
        return StraightResult(PlanStatus.START_STATE_IN_COLLISION, None, 0.0, 0.0, cause, f"at the start {cause}.")
    count = max(
        1, int(np.ceil(max(np.linalg.norm(length) / CONSTANTS.max_step, np.linalg.norm(turn) / CONSTANTS.max_turn)))
    )
    for _ in range(CONSTANTS.max_subdivisions):
        shares = np.linspace(0.0, 1.0, count + 1)
        q, lost = _joint_path(arm, tool, q0, T_start, length, turn, shares)
        deviation = _deviation(arm, tool, q, T_start, length)
        if deviation <= off_line:
            break
        count *= 2
    return _certified(arm, field, q, shares, lost or deviation > off_line, deviation, eps)


def along(T_world_tool: ArrayLike, distance: float, axis: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """Translate a tool pose (4, 4) by a signed distance [m] along an axis (3,) of the tool frame."""
    T = np.array(T_world_tool, dtype=np.float64)
    direction = np.asarray(axis, dtype=np.float64)
    T[:3, 3] += T[:3, :3] @ (direction / np.linalg.norm(direction)) * distance
    return T


def _joint_path(
    arm: RobotSpheres, tool: Array, q0: Array, T_start: Array, length: Array, turn: Array, shares: Array
) -> tuple[Array, bool]:
    """Return joint values (K, J) at the points up to the end of the branch, and whether the branch ends early."""
    chain = arm.robot.chain
    q = [q0]
    for share in shares[1:]:
        T = T_start.copy()
        T[:3, 3] += share * length
        T[:3, :3] = T_start[:3, :3] @ so3_exp(share * turn)
        found, error = inverse_kinematics(arm.native, chain, tool, T[None], q[-1][None])
        if (error[0] > IK.max_error).any() or np.abs(found[0] - q[-1]).max() > CONSTANTS.max_jump:
            return np.array(q), True
        q.append(found[0])
    return np.array(q), False


def _deviation(arm: RobotSpheres, tool: Array, q: Array, T_start: Array, length: Array) -> float:
    """Return the largest distance [m] of the tool from the line at the midpoints of the edges."""
    if len(q) < 2:
        return 0.0
    at = (arm.forward((q[:-1] + q[1:]) / 2)[:, -1] @ tool)[:, :3, 3] - T_start[:3, 3]
    size = float(np.linalg.norm(length))
    unit = length / size if size > 0 else np.zeros(3)
    return float(np.linalg.norm(at - (at @ unit)[:, None] * unit, axis=1).max())


def _certified(
    arm: RobotSpheres,
    field: GaussianCollisionField | None,
    q: Array,
    shares: Array,
    lost: bool,
    deviation: float,
    eps: float,
) -> StraightResult:
    edges = arm.certify(field, q[:-1], q[1:], eps=eps).in_collision
    good = int(np.argmax(edges)) if edges.any() else len(edges)
    path = _path(arm, field, q[: good + 1], eps) if good else None
    share = float(shares[good])
    if good < len(edges):
        cause = collision(arm, field, q[good + 1]) if field is not None else None
        reason = f"at {share:.0%} of the line {cause or 'the arm touches itself'}."
        return StraightResult(PlanStatus.GOAL_IN_COLLISION, path, share, deviation, cause, reason)
    if lost:
        reason = f"at {share:.0%} of the line the posture cannot continue without a jump, or a limit is reached."
        return StraightResult(PlanStatus.NO_IK_SOLUTION, path, share, deviation, None, reason)
    return StraightResult(PlanStatus.SUCCESS, path, 1.0, deviation)


def _path(arm: RobotSpheres, field: GaussianCollisionField | None, q: Array, eps: float) -> Path:
    clearance = 0.0
    if field is not None:
        # A cubic B-spline in which each control point occurs three times is the polyline itself.
        clearance = max(0.0, min_clearance(arm, field, np.repeat(q, 3, axis=0)))
    cost = float(np.linalg.norm(np.diff(q, axis=0), axis=1).sum())
    return Path(q, cost, Certificate(True, eps, clearance, arm.margin, -1 if field is None else field.map_version))


def _checked(arm: RobotSpheres, start: ArrayLike, end: ArrayLike, off_line: float) -> tuple[Array, Array, Array]:
    """Return start (J,), end (4, 4) and the pose (4, 4) of the tool on the last link, all finite."""
    if not off_line > 0.0:
        raise InputError(f"is {off_line}.", field="off_line", hint="give metres above 0")
    q = np.ascontiguousarray(start, dtype=np.float64)
    if q.shape != (len(arm.robot.chain),) or not np.isfinite(q).all():
        hint = f"{arm.robot.name} has {len(arm.robot.chain)} joints"
        raise StartError(f"is {q.shape}, or not finite.", field="start", hint=hint)
    T = np.asarray(end, dtype=np.float64)
    if not is_rigid(T):
        raise GoalError("is no rigid pose.", field="T_world_end", hint="give (4, 4) with an orthonormal rotation")
    if not isinstance(arm.robot, HasTool):
        raise GoalError("is a pose.", field="T_world_end", hint=f"{arm.robot.name} has no tool")
    return q, T, np.asarray(arm.robot.T_link_tcp, dtype=np.float64)

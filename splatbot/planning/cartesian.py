"""The tool along a straight line, as to approach a grasp and to retreat from it; certified, or the reason why not."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.collision.robot import EPS
from splatbot.errors import InputError
from splatbot.geometry import so3_exp, so3_log
from splatbot.planning.causes import collision
from splatbot.planning.ik import TOLERANCE, HasTool, inverse_kinematics, is_rigid
from splatbot.planning.problem import Cause, Certificate, GoalError, Path, PlanStatus, StartError
from splatbot.planning.timing import least_room
from splatbot.protocols import Array

STEP = 0.01  # [m] between places on the line
TURN = 0.05  # [rad] between them, at most
JUMP = 0.3  # [rad or m] of any joint from one place to the next; more is another branch
OFF_LINE = 1e-3  # [m] that the tool may be off the line between two places
_FINER = 4  # times the places are doubled where the tool would leave the line


@dataclass(frozen=True, eq=False)
class StraightResult:
    """What came of a straight line. True if all of it can be followed.

    Args:
        status: SUCCESS, NO_IK_SOLUTION, GOAL_IN_COLLISION or START_STATE_IN_COLLISION.
        path: from the start along as much of the line as is certified; None if there is nothing of it.
        share: how much of the line that is, 0..1.
        off_line: the most that the tool is off the line between two places [m].
        cause: what is in the way, if something is.
        reason: why it ends early, in one sentence; empty if it does not.
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
    off_line: float = OFF_LINE,
) -> StraightResult:
    """Move the tool from where it is at ``start`` straight to ``T_world_end``, turning evenly on the way.

    Joint values follow from place to place by inverse kinematics from the last ones, on one branch; the edges between
    them are certified, so what holds for the path holds between the places.

    Args:
        arm: the robot; what it holds is among its spheres.
        field: the map; without what is to be grasped, if that is to be touched. None: free of the arm itself alone.
        start: (J,)
        T_world_end: (4, 4) of the tool.
        eps: see :meth:`splatbot.collision.RobotSpheres.certify`.
        off_line: [m]

    Raises:
        StartError: the start does not fit the arm.
        GoalError: the end is no rigid pose, or the robot has no tool.
        InputError: ``off_line`` is not above 0.
    """
    q0, T_end = _checked(arm, start, T_world_end, off_line)
    tool = np.asarray(arm.robot.T_link_tcp, dtype=np.float64)  # type: ignore[attr-defined]
    T_start = arm.forward(q0[None])[0, -1] @ tool
    length, turn = T_end[:3, 3] - T_start[:3, 3], so3_log(T_start[:3, :3].T @ T_end[:3, :3])
    if arm.check(field, q0[None]).in_collision[0]:
        cause = collision(arm, field, q0) if field is not None else None
        return StraightResult(PlanStatus.START_STATE_IN_COLLISION, None, 0.0, 0.0, cause, f"at the start {cause}.")
    count = max(1, int(np.ceil(max(np.linalg.norm(length) / STEP, np.linalg.norm(turn) / TURN))))
    for _ in range(_FINER):
        shares = np.linspace(0.0, 1.0, count + 1)
        q, lost = _followed(arm, tool, q0, T_start, length, turn, shares)
        worst = _off_line(arm, tool, q, T_start, length)
        if worst <= off_line:
            break
        count *= 2
    return _certified(arm, field, q, shares, lost or worst > off_line, worst, eps)


def along(T_world_tool: ArrayLike, distance: float, axis: ArrayLike = (0.0, 0.0, 1.0)) -> Array:
    """A tool's pose (4, 4) moved by a distance [m] along an axis (3,) of its own; negative: back."""
    T = np.array(T_world_tool, dtype=np.float64)
    direction = np.asarray(axis, dtype=np.float64)
    T[:3, 3] += T[:3, :3] @ (direction / np.linalg.norm(direction)) * distance
    return T


def _followed(
    arm: RobotSpheres, tool: Array, q0: Array, T_start: Array, length: Array, turn: Array, shares: Array
) -> tuple[Array, bool]:
    """Joint values (K, J) at the places, as far as one branch goes, and whether it ends early."""
    chain = arm.robot.chain
    q = [q0]
    for share in shares[1:]:
        T = T_start.copy()
        T[:3, 3] += share * length
        T[:3, :3] = T_start[:3, :3] @ so3_exp(share * turn)
        found, miss = inverse_kinematics(arm.native, chain, tool, T[None], q[-1][None])
        if (miss[0] > TOLERANCE).any() or np.abs(found[0] - q[-1]).max() > JUMP:
            return np.array(q), True
        q.append(found[0])
    return np.array(q), False


def _off_line(arm: RobotSpheres, tool: Array, q: Array, T_start: Array, length: Array) -> float:
    """How far the tool is from the line in the middles of the edges [m]."""
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
    worst: float,
    eps: float,
) -> StraightResult:
    edges = arm.certify(field, q[:-1], q[1:], eps=eps).in_collision
    good = int(np.argmax(edges)) if edges.any() else len(edges)
    path = _path(arm, field, q[: good + 1], eps) if good else None
    share = float(shares[good])
    if good < len(edges):
        cause = collision(arm, field, q[good + 1]) if field is not None else None
        why = f"at {share:.0%} of the line {cause}." if cause else f"at {share:.0%} of the line the arm touches itself."
        return StraightResult(PlanStatus.GOAL_IN_COLLISION, path, share, worst, cause, why)
    if lost:
        why = f"at {share:.0%} of the line the posture cannot go on without a jump, or a limit is reached."
        return StraightResult(PlanStatus.NO_IK_SOLUTION, path, share, worst, None, why)
    return StraightResult(PlanStatus.SUCCESS, path, 1.0, worst)


def _path(arm: RobotSpheres, field: GaussianCollisionField | None, q: Array, eps: float) -> Path:
    room = 0.0
    if field is not None:
        # A spline with each place three times is the polyline itself.
        room = max(0.0, least_room(arm, field, np.repeat(q, 3, axis=0)))
    cost = float(np.linalg.norm(np.diff(q, axis=0), axis=1).sum())
    return Path(q, cost, Certificate(True, eps, room, arm.margin, -1 if field is None else field.map_version))


def _checked(arm: RobotSpheres, start: ArrayLike, end: ArrayLike, off_line: float) -> tuple[Array, Array]:
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
    return q, T

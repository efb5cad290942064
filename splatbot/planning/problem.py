"""What a planner is asked and what it answers: goals, problems, paths with certificates, and typed failures."""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError, SplatbotError
from splatbot.protocols import Array


class PlanStatus(IntEnum):
    """How planning ended; the values are those of ``moveit_msgs/MoveItErrorCodes``."""

    SUCCESS = 1
    PLANNING_FAILED = -1  # the trees cannot grow: iterations are used up, or nothing is left to try
    TIMED_OUT = -6
    PREEMPTED = -7  # cancelled
    START_STATE_IN_COLLISION = -10
    GOAL_IN_COLLISION = -12
    START_STATE_INVALID = -26  # out of the joints' limits
    GOAL_STATE_INVALID = -27
    NO_IK_SOLUTION = -31


class StartError(InputError):
    """The start is no configuration of this robot (INVALID_ROBOT_STATE)."""

    code = -17


class GoalError(InputError):
    """The goal makes no sense for this robot (INVALID_GOAL_CONSTRAINTS)."""

    code = -16


class PlanningError(SplatbotError):
    """No path was found; ``code`` is the :class:`PlanStatus` and ``result`` what is known."""

    http_status = 422

    def __init__(self, result: PlanResult) -> None:
        self.result = result
        self.code = int(result.status)
        hint = _HINTS.get(result.status)
        super().__init__(result.reason, field=_FIELDS.get(result.status, "plan"), hint=hint)


_FIELDS = {
    PlanStatus.START_STATE_IN_COLLISION: "start",
    PlanStatus.START_STATE_INVALID: "start",
    PlanStatus.GOAL_IN_COLLISION: "goal",
    PlanStatus.GOAL_STATE_INVALID: "goal",
    PlanStatus.NO_IK_SOLUTION: "goal",
}

_HINTS = {
    PlanStatus.PLANNING_FAILED: "give more iterations, or a goal that can be reached",
    PlanStatus.TIMED_OUT: "give a larger budget_ms, a smaller margin, or a goal that can be reached",
    PlanStatus.START_STATE_IN_COLLISION: "move the arm away, mask it out of the map, or plan with a smaller margin",
    PlanStatus.START_STATE_INVALID: "give a start within the joints' limits",
    PlanStatus.GOAL_IN_COLLISION: "give a goal with room around the arm, or plan with a smaller margin",
    PlanStatus.GOAL_STATE_INVALID: "give a goal within the joints' limits",
    PlanStatus.NO_IK_SOLUTION: "give a pose within reach, or a region around it",
}


@dataclass(frozen=True)
class Cause:
    """What is in the way.

    Args:
        link: the link that touches something; -1: none does.
        other: the link that it touches; -1: it is the map.
        gaussian: row of the Gaussian in the model; -1: it is the arm itself.
        depth: how deep the arm is in it [m].
        joint: the joint that is out of its limits, -1: none; ``depth`` is then how far [rad or m].
    """

    link: int = -1
    other: int = -1
    gaussian: int = -1
    depth: float = 0.0
    joint: int = -1

    def __str__(self) -> str:
        if self.joint >= 0:
            return f"joint {self.joint} is {self.depth:.4g} beyond its limit"
        if self.link < 0:
            return "nothing is in the way"
        if self.other >= 0:
            return f"link {self.link} touches link {self.other}, {1e3 * self.depth:.1f} mm deep"
        return f"link {self.link} is {1e3 * self.depth:.1f} mm deep in Gaussian {self.gaussian}"


@dataclass(frozen=True, eq=False)
class JointGoal:
    """Configurations (K, J) or (J,), any one of which will do."""

    q: ArrayLike


@dataclass(frozen=True, eq=False)
class PoseGoal:
    """The tool at a pose, in any posture.

    Args:
        T_world_tcp: (4, 4) [m].
        position: (3,) half-widths of a box around it, along the goal's axes [m]; 0: exactly there.
        angle: (3,) largest rotation vector from it, component by component, about the goal's axes [rad]; pi: any.
        postures: how many different configurations to look for.

    With ``position`` or ``angle`` above 0 this is a region: configurations anywhere in it will do.
    """

    T_world_tcp: ArrayLike
    position: ArrayLike = (0.0, 0.0, 0.0)
    angle: ArrayLike = (0.0, 0.0, 0.0)
    postures: int = 16


Goal = JointGoal | PoseGoal


@dataclass(frozen=True, eq=False)
class PlanningProblem:
    """From where to where.

    Args:
        start: (J,) configuration [rad or m].
        goal: what will do as an end; an array counts as a :class:`JointGoal`.
    """

    start: ArrayLike
    goal: Goal | ArrayLike


@dataclass(frozen=True)
class Certificate:
    """That every configuration on a path, not only the waypoints, is free of the map's ellipsoids and of the arm.

    Args:
        certified: whether so.
        eps: [m], see :meth:`splatbot.collision.RobotSpheres.certify`.
        clearance: [m] that the arm has at least to the map all along, beyond the margin; at most ``CLEARANCE_CUT``.
        margin: [m] that the spheres were enlarged by.
        map_version: the state of the map that it holds for.
    """

    certified: bool
    eps: float
    clearance: float
    margin: float
    map_version: int


@dataclass(frozen=True, eq=False)
class Path:
    """A path of straight edges in joint space.

    Args:
        waypoints: (N, J), N >= 2 [rad or m]; a path from a place to itself has it twice.
        cost: its length [rad], the sum of the edges' Euclidean lengths.
        certificate: what is known of it.
    """

    waypoints: Array
    cost: float
    certificate: Certificate

    def __len__(self) -> int:
        """Number of waypoints."""
        return len(self.waypoints)

    def at(self, share: ArrayLike) -> Array:
        """Configurations (..., J) at shares (...) of its length, 0 the start and 1 the goal; beyond, the ends."""
        steps = np.linalg.norm(np.diff(self.waypoints, axis=0), axis=1)
        along = np.concatenate([[0.0], np.cumsum(steps)])
        wanted = np.clip(np.asarray(share, dtype=np.float64), 0.0, 1.0) * along[-1]
        return np.stack([np.interp(wanted, along, column) for column in self.waypoints.T], axis=-1)


@dataclass(frozen=True, eq=False)
class PlanResult:
    """What planning came to. True if there is a path.

    Args:
        status: how it ended.
        path: the best one found; None unless ``status`` is SUCCESS.
        history: (H, 2) of (seconds since the call, cost [rad]) each time a better path was found; costs fall.
        cause: what is in the way of the start or the goal, where that is why there is no path.
        reason: why there is no path, in one sentence; empty if there is one.
        seconds: that the call took.
        iterations: of the trees' growth.
        edges: that were checked.
        nodes: in the tree at the end.
        map_version: the state of the map that was asked.
    """

    status: PlanStatus
    path: Path | None
    history: NDArray[np.float64]
    cause: Cause | None
    reason: str
    seconds: float
    iterations: int
    edges: int
    nodes: int
    map_version: int

    def __bool__(self) -> bool:
        return self.path is not None

    @property
    def first_seconds(self) -> float:
        """When the first path was there; infinity if there is none."""
        return float(self.history[0, 0]) if len(self.history) else np.inf

    def unwrap(self) -> Path:
        """The path.

        Raises:
            PlanningError: there is none; it names the status and the cause.
        """
        if self.path is None:
            raise PlanningError(self)
        return self.path

"""Inputs and outputs of a planner: goals, problems, paths with certificates, and typed failures."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError, SplatbotError
from splatbot.protocols import Array


class PlanStatus(IntEnum):
    """Result of planning; the values are those of ``moveit_msgs/MoveItErrorCodes``."""

    SUCCESS = 1
    PLANNING_FAILED = -1  # the iterations are used up, or the trees cannot grow
    TIMED_OUT = -6
    PREEMPTED = -7  # cancelled
    START_STATE_IN_COLLISION = -10
    GOAL_IN_COLLISION = -12
    START_STATE_INVALID = -26  # outside the joint limits
    GOAL_STATE_INVALID = -27
    NO_IK_SOLUTION = -31


class StartError(InputError):
    """Error: the start is no configuration of this robot (INVALID_ROBOT_STATE)."""

    code = -17


class GoalError(InputError):
    """Error: the goal is invalid for this robot (INVALID_GOAL_CONSTRAINTS)."""

    code = -16


class PlanningError(SplatbotError):
    """Error: no path was found; ``code`` is the :class:`PlanStatus`, ``result`` the :class:`PlanResult`."""

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
    PlanStatus.GOAL_IN_COLLISION: "give a goal with more clearance, or plan with a smaller margin",
    PlanStatus.GOAL_STATE_INVALID: "give a goal within the joints' limits",
    PlanStatus.NO_IK_SOLUTION: "give a pose within reach, or a region around it",
}


@dataclass(frozen=True)
class Cause:
    """Collision or limit violation that makes a configuration invalid.

    Args:
        link: index of the link in contact, -1 if no link is.
        other: index of the link that it touches, -1 if it touches the map.
        gaussian: row of the touched Gaussian in the model, -1 if the arm touches itself.
        depth: penetration depth [m]; below 0 it is clearance.
        joint: index of the joint outside its limits, -1 if all are within; ``depth`` is then the excess [rad or m].
        name: name of that joint, or of the joint that moves the link; "" for the base.
        at_base: (3,) centre of the sphere that is deepest in the map, in the base frame [m]; None without one.
        held: whether an object in the hand is in contact, and not the link that carries it.
    """

    link: int = -1
    other: int = -1
    gaussian: int = -1
    depth: float = 0.0
    joint: int = -1
    name: str = ""
    at_base: tuple[float, float, float] | None = None
    held: bool = False

    def __str__(self) -> str:
        if self.joint >= 0:
            named = f" ({self.name})" if self.name else ""
            return f"joint {self.joint}{named} is {self.depth:.4g} beyond its limit"
        if self.link < 0:
            return "no obstacle is found"
        if self.other >= 0:
            return f"{self.part} touches link {self.other}, {1e3 * self.depth:.1f} mm deep"
        return f"{self.deep_in('the map')}, in Gaussian {self.gaussian}"

    @property
    def part(self) -> str:
        """Return the words for the part of the arm in contact."""
        return "the held object" if self.held else link_words(self.link, self.name)

    def deep_in(self, obstacle: str) -> str:
        """Describe the contact of the link with an obstacle, and its place."""
        at = "" if self.at_base is None else f" at {place_words(self.at_base)}"
        deep = f"{1e3 * max(self.depth, 0.0):.1f} mm deep"
        return f"{self.part} is {deep} in {obstacle}{at}"


def link_words(link: int, joint: str) -> str:
    """Return the words for a link and the joint that moves it; "" for the base."""
    return f"link {link}" + (f" (after {joint})" if joint else "")


def place_words(at_base: Sequence[float]) -> str:
    """Return the words for a point (3,) in the frame of the base [m]."""
    return f"({', '.join(f'{x:.2f}' for x in at_base)}) m from the base"


@dataclass(frozen=True, eq=False)
class JointGoal:
    """Goal set of configurations (K, J) or (J,) [rad or m]; a path to any of them is a solution."""

    q: ArrayLike


@dataclass(frozen=True, eq=False)
class PoseGoal:
    """Goal pose of the tool in any posture, or a goal region around it.

    A tool pose ``T_world_tcp · (t, exp(r))`` lies in the region if ``|t| <= position`` and ``|r| <= angle`` in each
    component.

    Args:
        T_world_tcp: (4, 4) pose [m].
        position: (3,) half-widths of the box of translations t along the axes of the goal [m].
        angle: (3,) largest components of the rotation vector r about the axes of the goal [rad]; pi allows any.
        postures: largest number of distinct configurations to find.
    """

    T_world_tcp: ArrayLike
    position: ArrayLike = (0.0, 0.0, 0.0)
    angle: ArrayLike = (0.0, 0.0, 0.0)
    postures: int = 16


Goal = JointGoal | PoseGoal


@dataclass(frozen=True, eq=False)
class PlanningProblem:
    """Start and goal of a plan.

    Args:
        start: (J,) configuration [rad or m].
        goal: goal set or region; an array counts as a :class:`JointGoal`.
    """

    start: ArrayLike
    goal: Goal | ArrayLike


@dataclass(frozen=True)
class Certificate:
    """Proof that each configuration on a continuous path is free of the map's ellipsoids and of self-collision.

    Args:
        certified: True if the proof exists.
        eps: resolution of the proof [m], see :meth:`splatbot.collision.RobotSpheres.certify`.
        clearance: lower bound of the clearance along the path, less the margin [m]; at most 0.1 for a path, and 0.05
            for a trajectory.
        margin: enlargement of the spheres against the map [m].
        map_version: version of the map that the proof refers to.
    """

    certified: bool
    eps: float
    clearance: float
    margin: float
    map_version: int


@dataclass(frozen=True, eq=False)
class Path:
    """Path of straight edges in joint space.

    Args:
        waypoints: (N, J), N >= 2 [rad or m]; a path whose start is its goal contains it twice.
        cost: length of the path, the sum of the Euclidean lengths of its edges [rad].
        certificate: its proof against the map.
    """

    waypoints: Array
    cost: float
    certificate: Certificate

    def __len__(self) -> int:
        """Return the number of waypoints."""
        return len(self.waypoints)

    def at(self, share: ArrayLike) -> Array:
        """Return configurations (..., J) at fractions (...) of the length, clamped to 0 (start) and 1 (goal)."""
        steps = np.linalg.norm(np.diff(self.waypoints, axis=0), axis=1)
        arc_length = np.concatenate([[0.0], np.cumsum(steps)])
        s = np.clip(np.asarray(share, dtype=np.float64), 0.0, 1.0) * arc_length[-1]
        return np.stack([np.interp(s, arc_length, column) for column in self.waypoints.T], axis=-1)


@dataclass(frozen=True, eq=False)
class PlanResult:
    """Result of a call of the planner. True if there is a path.

    Args:
        status: success or kind of failure.
        path: best path found; None unless ``status`` is SUCCESS.
        history: (H, 2) rows (time since the call [s], cost [rad]), one for each improvement; the costs decrease.
        cause: collision or limit violation of the start, the goal or the straight edge, if it explains the failure.
        reason: one sentence that explains the failure; empty on success.
        seconds: duration of the call [s].
        iterations: number of extensions of the trees.
        edges: number of certified edges.
        nodes: number of nodes in the final tree.
        map_version: version of the map.
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
        """Time from the call to the first path [s]; infinity without a path."""
        return float(self.history[0, 0]) if len(self.history) else np.inf

    def unwrap(self) -> Path:
        """Return the path.

        Raises:
            PlanningError: there is no path; the error names the status and the cause.
        """
        if self.path is None:
            raise PlanningError(self)
        return self.path

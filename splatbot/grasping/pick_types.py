"""Options, stages and results of a pick."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from splatbot.errors import InputError, SplatbotError
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.types import Grasp
from splatbot.planning import JointTrajectory
from splatbot.protocols import Array


class PickStage(StrEnum):
    """Stages of a pick, in their order."""

    GRASP = "grasp"
    PLAN = "plan"
    OPEN = "open"
    MOVE = "move"
    LOOK = "look"
    ADJUST = "adjust"
    APPROACH = "approach"
    CLOSE = "close"
    LIFT = "lift"
    CHECK = "check"
    CARRY = "carry"


class PickOutcome(StrEnum):
    """Outcome of a pick."""

    PICKED = "picked"
    NO_GRASP = "no grasp"
    NO_PLAN = "no plan"  # no grasp has a certified plan
    NOT_FOLLOWED = "not followed"  # the controller faulted or did not reach the end of the trajectory
    GRIPPER_FAILED = "gripper failed"
    TARGET_MOVED = "target moved"  # the look before the grasp does not find it near its place in the map
    OBSTRUCTED = "obstructed"  # the look before the grasp shows something in the hand's way
    NOTHING_HELD = "nothing held"
    UNEXPECTED_WIDTH = "unexpected width"  # the fingers hold something of another width
    LOST = "lost"  # the fingers held the object and lost it
    STOPPED = "stopped"


_CODES = {
    PickOutcome.NO_GRASP: -31,  # NO_IK_SOLUTION
    PickOutcome.NO_PLAN: -1,  # PLANNING_FAILED
    PickOutcome.STOPPED: -7,  # PREEMPTED
}


@dataclass(frozen=True)
class PickOptions:
    """Options of a pick.

    Args:
        lift: height of the lift [m].
        lift_off: first part of the lift [m], on which the object separates from its support. Only the arm is certified
            on it, since the object is still in contact.
        force: grip force [N]. If None, the gripper uses its default.
        speed: fraction of the arm's velocity and acceleration limits.
        slow: additional factor on ``speed`` for approach, lift and carry.
        tries: maximum number of grasps for which a plan is searched.
        budget_ms: planning budget for the path to each pre-grasp [ms].
        grasp: options of grasp sampling.
        attempts: largest number of grasps that are executed. A second one needs a wrist camera, because a failed grasp
            may move the object.
        width_tolerance: largest difference between the expected width and that at which the fingers rest [m].
        carry_to: (J,) joint positions to which the object is carried. If None, the object stays lifted.
        seed: seed of the motion planner.

    Raises:
        InputError: a value is out of range.
    """

    lift: float = 0.15
    lift_off: float = 0.03
    force: float | None = None
    speed: float = 0.5
    slow: float = 0.3
    tries: int = 5
    budget_ms: float = 200.0
    grasp: GraspOptions = field(default_factory=GraspOptions)
    attempts: int = 3
    width_tolerance: float = 0.015
    carry_to: tuple[float, ...] | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        good = 0.0 < self.lift_off < self.lift <= 1.0 and 0.0 < self.speed <= 1.0 and 0.0 < self.slow <= 1.0
        counts = min(self.tries, self.attempts) >= 1 and self.budget_ms > 0.0 and self.width_tolerance > 0.0
        if not good or not counts or (self.force is not None and not self.force > 0.0):
            hint = "give metres with 0 < lift_off < lift <= 1, fractions in 0..1, tries >= 1, and newtons above 0"
            raise InputError("is out of range.", field="options", hint=hint)


@dataclass(frozen=True)
class PickStep:
    """A completed stage, or the stage in which the pick ended.

    Args:
        stage: the stage.
        seconds: its duration [s].
        note: its result in one line.
    """

    stage: PickStage
    seconds: float
    note: str


@dataclass(frozen=True, eq=False)
class PickMotion:
    """A motion of the arm that a pick executed.

    Args:
        stage: its stage.
        trajectory: the certified trajectory.
        opening: finger opening with which it is certified [m].
    """

    stage: PickStage
    trajectory: JointTrajectory
    opening: float


@dataclass(frozen=True, eq=False)
class PickResult:
    """Result of a pick; its truth value is True if the object is held.

    Args:
        outcome: the outcome.
        stage: the stage in which the pick ended.
        reason: reason of a failure, one sentence; empty if the object is held.
        grasp: the executed grasp. If None, no grasp was selected.
        steps: the stages, in order.
        opening: finger opening on the object [m]. If None, the fingers were not closed.
        attached: (A, 4) spheres (x, y, z, radius) [m] of the attached object in the frame of the last link. If None, no
            object is held.
        q: (J,) last commanded joint positions. If None, the arm did not move.
        error: error of the component that failed.
        planning_seconds: duration of planning the path to the pre-grasp [s]. If None, no plan was found.
        attempts: number of grasps that were executed.
        shift: distance by which the last look found the target moved [m]. If None, there was no look.
        notes: remarks on the executed plan, each a sentence.
        motions: motions of the arm that were sent to the controller, in order.
    """

    outcome: PickOutcome
    stage: PickStage
    reason: str
    grasp: Grasp | None
    steps: tuple[PickStep, ...]
    opening: float | None = None
    attached: Array | None = None
    q: Array | None = None
    error: SplatbotError | None = None
    planning_seconds: float | None = None
    notes: tuple[str, ...] = ()
    attempts: int = 0
    shift: float | None = None
    motions: tuple[PickMotion, ...] = ()

    def __bool__(self) -> bool:
        return self.outcome is PickOutcome.PICKED

    def unwrap(self) -> Grasp:
        """Return the grasp that holds the object.

        Raises:
            PickError: the object is not held.
        """
        if self.outcome is not PickOutcome.PICKED or self.grasp is None:
            raise PickError(self)
        return self.grasp


class PickError(SplatbotError):
    """Error of a failed pick; ``result`` holds the outcome and the stage."""

    http_status = 409

    def __init__(self, result: PickResult) -> None:
        self.result = result
        self.code = _CODES.get(result.outcome, -4)  # CONTROL_FAILED
        super().__init__(f"{result.outcome}: {result.reason}", field=result.stage, hint=_HINTS[result.outcome])


_HINTS = {
    PickOutcome.PICKED: None,
    PickOutcome.NO_GRASP: "see the target from more sides, or take another",
    PickOutcome.NO_PLAN: "clear the surroundings, give more tries or a larger budget_ms",
    PickOutcome.NOT_FOLLOWED: "reset the controller and remove the obstacle",
    PickOutcome.GRIPPER_FAILED: "check the gripper and activate it",
    PickOutcome.TARGET_MOVED: "map the scene again",
    PickOutcome.OBSTRUCTED: "map the scene again: something is where the hand has to be",
    PickOutcome.UNEXPECTED_WIDTH: "map the target from more sides, or allow more (width_tolerance)",
    PickOutcome.NOTHING_HELD: "map the target again: it may have moved",
    PickOutcome.LOST: "press harder, lift slower, or grasp nearer to its middle",
    PickOutcome.STOPPED: None,
}

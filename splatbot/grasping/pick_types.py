"""What a pick is told, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import StrEnum

from splatbot.errors import InputError, SplatbotError
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.types import Grasp
from splatbot.protocols import Array


class PickStage(StrEnum):
    """In the order in which they come."""

    GRASP = "grasp"
    PLAN = "plan"
    OPEN = "open"
    MOVE = "move"
    APPROACH = "approach"
    CLOSE = "close"
    LIFT = "lift"
    CHECK = "check"
    CARRY = "carry"


class PickOutcome(StrEnum):
    """How a pick ended."""

    PICKED = "picked"
    NO_GRASP = "no grasp"
    NO_WAY = "no way"  # every grasp's way is blocked
    NOT_FOLLOWED = "not followed"  # the arm faulted or did not arrive
    GRIPPER_FAILED = "gripper failed"
    NOTHING_HELD = "nothing held"
    LOST = "lost"  # it was held, and is no more
    STOPPED = "stopped"


_CODES = {
    PickOutcome.NO_GRASP: -31,  # NO_IK_SOLUTION
    PickOutcome.NO_WAY: -1,  # PLANNING_FAILED
    PickOutcome.STOPPED: -7,  # PREEMPTED
}


@dataclass(frozen=True)
class PickOptions:
    """How to pick.

    Args:
        lift: how far up [m].
        free: the first part of it [m], on which the object leaves what it stands on: certified for the arm, not for it.
        force: of the fingers [N]; None: the gripper's own.
        speed: share of the arm's limits; of the straight stretches, ``slow`` of that.
        slow: see there.
        tries: grasps whose way is looked for.
        budget_ms: for the way to each.
        grasp: how grasps are looked for.
        carry_to: (J,) where to take the object; None: it stays lifted.
        seed: of the planner.

    Raises:
        InputError: a value is out of range.
    """

    lift: float = 0.15
    free: float = 0.03
    force: float | None = None
    speed: float = 0.5
    slow: float = 0.3
    tries: int = 5
    budget_ms: float = 200.0
    grasp: GraspOptions = field(default_factory=GraspOptions)
    carry_to: tuple[float, ...] | None = None
    seed: int = 0

    def __post_init__(self) -> None:
        good = 0.0 < self.free < self.lift <= 1.0 and 0.0 < self.speed <= 1.0 and 0.0 < self.slow <= 1.0
        if not good or self.tries < 1 or not self.budget_ms > 0.0 or (self.force is not None and not self.force > 0.0):
            hint = "give metres with 0 < free < lift <= 1, shares in 0..1, a number of tries, and newtons above 0"
            raise InputError("is out of range.", field="options", hint=hint)


@dataclass(frozen=True)
class PickStep:
    """A stage that was done, or that the pick ended in.

    Args:
        stage: which.
        seconds: that it took.
        note: what came of it.
    """

    stage: PickStage
    seconds: float
    note: str


@dataclass(frozen=True, eq=False)
class PickResult:
    """What came of a pick. True if the object is held.

    Args:
        outcome: how it ended.
        stage: in which stage.
        reason: in one sentence; empty if it is held.
        grasp: that was taken; None: there was none.
        steps: the stages, in order.
        opening: of the fingers on the object [m]; None: they did not get there.
        attached: (A, 4) spheres of the object in the last link's frame, as planning takes it along; None likewise.
        q: (J,) where the arm was told to be last; None: it did not move.
        error: of a part that failed.
        planned: seconds that the search for the way to the pre-grasp took; None: there is no way.
        notes: what else is to be known of the way that was taken, each in a sentence.
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
    planned: float | None = None
    notes: tuple[str, ...] = ()

    def __bool__(self) -> bool:
        return self.outcome is PickOutcome.PICKED

    def unwrap(self) -> Grasp:
        """The grasp that holds the object.

        Raises:
            PickError: it is not held.
        """
        if self.outcome is not PickOutcome.PICKED or self.grasp is None:
            raise PickError(self)
        return self.grasp


class PickError(SplatbotError):
    """A pick that did not succeed; ``result`` has the outcome and the stage."""

    http_status = 409

    def __init__(self, result: PickResult) -> None:
        self.result = result
        self.code = _CODES.get(result.outcome, -4)  # CONTROL_FAILED
        super().__init__(f"{result.outcome}: {result.reason}", field=result.stage, hint=_HINTS[result.outcome])


_HINTS = {
    PickOutcome.PICKED: None,
    PickOutcome.NO_GRASP: "see the target from more sides, or take another",
    PickOutcome.NO_WAY: "clear what is around, give more tries or a larger budget_ms",
    PickOutcome.NOT_FOLLOWED: "reset the controller; look at what holds the arm up",
    PickOutcome.GRIPPER_FAILED: "check the gripper and activate it",
    PickOutcome.NOTHING_HELD: "map the target again: it may have moved",
    PickOutcome.LOST: "press harder, lift slower, or grasp nearer to its middle",
    PickOutcome.STOPPED: None,
}

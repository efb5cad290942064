"""One trial: a scene is scanned once; each stack decides from the scan alone, and its pick is tried in two twins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from splatbot.errors import SplatbotError
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.affordance import AffordanceError, Target
from splatbot.grasping.pick import Picker
from splatbot.grasping.pick_types import PickOutcome, PickResult, PickStage
from splatbot.planning.follow import follow
from splatbot.protocols import Array
from splatbot.sim.camera import TwinCamera
from splatbot.sim.compare.held_out import HeldOutTwin, Spread, draw
from splatbot.sim.contact_monitor import ContactMonitor
from splatbot.sim.controller import TwinController
from splatbot.sim.trials.look import Look, UnseenError, look
from splatbot.sim.trials.scenes import TABLE, TrialScene
from splatbot.sim.trials.shake import Shake
from splatbot.sim.trials.stacks import OPTIONS, Knowledge, Stack, StackDecision, decide
from splatbot.sim.twin import Twin
from splatbot.sim.video import Video
from splatbot.sim.world import OBJECT

RISE = 0.15  # [m] that a thing must be lifted
KEPT = 0.12  # [m] over where it stood, after it was shaken
_TAKEN_FOR = 0.04  # [m] between a target's middle and that of what was found
_EVERY = 5  # control periods between looks at what touches
_TWINS = ("ideal", "reality")

Watch = Callable[[Any, float], None]


class Failure(StrEnum):
    """Why a trial failed."""

    PERCEPTION = "perception"  # what was clicked at was not found, or taken for something else
    GRASP = "grasp"  # no hand fits it, or the fingers closed on nothing
    IK = "ik"  # hands fit, the arm does not get there
    PLAN = "plan"  # no way
    SLIP = "slip"  # it was held, and fell
    COLLISION = "collision"  # something else was touched before
    CONTROL = "control"  # the arm did not follow


@dataclass(frozen=True)
class TwinPickResult:
    """A pick in one twin.

    Args:
        success: lifted and still held after it was shaken.
        failure: of :class:`Failure`, empty after success.
        outcome: of the pick, "dropped" where it was lost in the shaking.
        reason: in words.
        rose: how far the target was lifted [m]; ``kept``: how far above its place it is after shaking [m].
        touched: what the arm touched beside the target.
        opening: of the fingers on it [m]; None: they did not get there.
    """

    success: bool
    failure: str
    outcome: str
    reason: str
    rose: float = 0.0
    kept: float = 0.0
    touched: tuple[str, ...] = ()
    opening: float | None = None


@dataclass(frozen=True)
class TrialRow:
    """A stack in one scene.

    Args:
        seed, family, stack: which.
        kind: of the target.
        moving: whether something moved through the scene.
        ideal: in the twin of the scene as it is described.
        reality: in a held-out twin: other friction, masses, gains and delays, every effect on.
        plan_ms: that the search for the way took; None: there was none.
        grasp_ms: to the ranked list.
        build_s: to make the stack's world of the frames, mapping included; None: none was made.
        world_bytes: of that world; None likewise.
        width_mm: of the grasp; None: there was none.
        frames, pixels: of the scan, and how wide its pictures are [px].
    """

    seed: int
    family: str
    stack: str
    kind: str
    moving: bool
    ideal: TwinPickResult
    reality: TwinPickResult
    plan_ms: float | None
    grasp_ms: float | None
    build_s: float | None
    world_bytes: int | None
    width_mm: float | None
    frames: int
    pixels: int

    def to_dict(self) -> dict[str, Any]:
        """As JSON takes it."""
        return asdict(self)

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> TrialRow:
        """The other way round of :meth:`to_dict`."""
        twins = {
            name: TwinPickResult(**{**values[name], "touched": tuple(values[name]["touched"])})
            for name in ("ideal", "reality")
        }
        return cls(**{**values, **twins})


def run_trial(
    trial: TrialScene, stacks: Sequence[Stack], *, frames: int = 32, width: int = 320, videos: Path | None = None
) -> list[TrialRow]:
    """Scan a scene, and let each stack pick its target. One that no picture shows is a failure of each.

    Args:
        trial: the scene.
        stacks: who picks.
        frames, width: of the scan, see :func:`splatbot.sim.trials.look.look`.
        videos: folder for films of picks that failed in reality; None: none are made.
    """
    try:
        seen = look(trial, frames=frames, width=width)
    except UnseenError as error:
        both = _no_target(error)
        return [_row(stack, trial, (frames, width), None, None, None, both, both) for stack in stacks]
    return [pick_with(stack, trial, seen, videos=videos) for stack in stacks]


def pick_with(stack: Stack, trial: TrialScene, seen: Look, *, videos: Path | None = None) -> TrialRow:
    """One stack's pick of what was seen, in both twins."""
    known = stack.learn(seen)
    scan = len(seen.frames), seen.frames[0].camera.width
    try:
        decision = decide(known, seen)
    except AffordanceError as error:
        both = _no_target(error)
        return _row(stack, trial, scan, known, None, None, both, both)
    results = []
    mistaken = _mistaken(known, decision.target, trial)
    for twin in (Twin(trial.scene), _reality(trial)):
        results.append(attempt(decision, trial, twin, mistaken=mistaken))
    (ideal, first), (reality, _) = results
    if videos is not None and not reality.success:
        _film(decision, trial, videos / f"{trial.family}-{trial.seed}-{stack.name}.mp4")
    return _row(stack, trial, scan, known, decision, first, ideal, reality)


def attempt(
    decision: StackDecision, trial: TrialScene, twin: Twin, *, mistaken: bool = False, watch: Watch | None = None
) -> tuple[TwinPickResult, PickResult]:
    """The pick in a twin, then the shaking.

    Args:
        decision: what to pick and how.
        trial: the scene.
        twin: of it.
        mistaken: whether the decision is about something else than the trial's target.
        watch: called with MuJoCo's data and the time [s] after every control period.
    """
    controller = _Watched(twin, watch)
    assert controller.gripper is not None
    before = _height(twin, trial.target)
    picker = Picker(
        decision.sampler, controller, controller.gripper, options=OPTIONS, make_planner=lambda target: decision.ways
    )
    result = picker.pick(decision.target, grasps=decision.grasps)
    rose = _height(twin, trial.target) - before
    early = controller.touched(trial.target)
    kept, shaken = rose, ""
    if result and result.q is not None:
        try:
            done = follow(controller, Shake(decision.sampler.robot.chain, result.q))
            shaken = "" if done else done.fault or f"the arm ended {done.state}"
        except SplatbotError as error:
            shaken = error.message
        kept = _height(twin, trial.target) - before
    success = bool(result) and rose >= RISE and kept >= KEPT
    outcome, reason = str(result.outcome), result.reason
    if result and not success:
        outcome = "dropped" if rose >= RISE else "lost"
        reason = shaken or f"rose {1e3 * rose:.0f} mm, {1e3 * kept:.0f} mm after it was shaken"
    failure = "" if success else _failure(result, early, mistaken)
    touched = controller.touched(trial.target)
    return TwinPickResult(success, failure, outcome, reason, rose, kept, touched, result.opening), result


class _Watched(TwinController):
    """A twin's controller that takes note of what its arm touches."""

    def __init__(self, twin: Twin, watch: Watch | None) -> None:
        self._touches, self._periods, self._watch = ContactMonitor(twin.world), 0, watch
        super().__init__(twin)

    def _advance(self, q: Array, velocity: Array, acceleration: Array) -> None:
        super()._advance(q, velocity, acceleration)
        self._periods += 1
        if self._watch is not None:
            self._watch(self.twin.data, self._clock)
        if self._periods % _EVERY == 0:
            self._touches.look(self.twin.data, self._clock)

    def touched(self, target: str) -> tuple[str, ...]:
        """The things but the target that the arm has touched."""
        things = {thing.name for thing in self.twin.scene.objects} - {target}
        return tuple(sorted({touch.other for touch in self._touches.found} & things))


def _reality(trial: TrialScene) -> HeldOutTwin:
    return HeldOutTwin(trial.scene, draw(Spread(), trial.seed))


def _film(decision: StackDecision, trial: TrialScene, path: Path) -> None:
    """The pick in reality once more, with a camera."""
    twin = _reality(trial)
    video = Video(path, TwinCamera(twin.world, seed=trial.seed))
    try:
        attempt(decision, trial, twin, watch=video)
    finally:
        video.close()


def _failure(result: PickResult, touched: tuple[str, ...], mistaken: bool) -> Failure:
    if mistaken:
        return Failure.PERCEPTION
    if result.outcome is PickOutcome.NO_GRASP:
        return Failure.IK if "hands: " in result.reason else Failure.GRASP
    if result.outcome is PickOutcome.NO_PLAN:
        return Failure.PLAN
    if set(touched) - {TABLE}:
        return Failure.COLLISION
    if result.outcome is PickOutcome.NOTHING_HELD:
        return Failure.GRASP
    if result.outcome is PickOutcome.LOST or result.outcome is PickOutcome.PICKED:
        return Failure.SLIP
    late = (PickStage.LIFT, PickStage.CHECK)
    return Failure.COLLISION if touched and result.stage not in late else Failure.CONTROL


def _mistaken(known: Knowledge, target: Target, trial: TrialScene) -> bool:
    """Whether what was found is not where the target is."""
    points = known.scene.model.means.detach().double().numpy()[target.rows]
    found = transform_points(inverse(known.scene.T_world_base), points)
    middle = (found.min(axis=0) + found.max(axis=0))[:2] / 2
    true = next(np.asarray(thing.at) for thing in trial.scene.objects if thing.name == trial.target)
    return bool(np.linalg.norm(middle - true[:2]) > _TAKEN_FOR)


def _no_target(error: SplatbotError) -> TwinPickResult:
    return TwinPickResult(False, Failure.PERCEPTION, "no target", error.message)


def _height(twin: Twin, name: str) -> float:
    return float(twin.data.body(OBJECT + name).xipos[2])


def _row(
    stack: Stack,
    trial: TrialScene,
    scan: tuple[int, int],
    known: Knowledge | None,
    decision: StackDecision | None,
    result: PickResult | None,
    ideal: TwinPickResult,
    reality: TwinPickResult,
) -> TrialRow:
    planned = None if result is None or result.planning_seconds is None else 1e3 * result.planning_seconds
    return TrialRow(
        seed=trial.seed,
        family=trial.family,
        stack=stack.name,
        kind=trial.kind,
        moving=trial.moving,
        ideal=ideal,
        reality=reality,
        plan_ms=planned,
        grasp_ms=None if decision is None else 1e3 * decision.seconds,
        build_s=None if known is None else known.seconds,
        world_bytes=None if known is None else known.world_bytes,
        width_mm=None if result is None or result.grasp is None else 1e3 * result.grasp.width,
        frames=scan[0],
        pixels=scan[1],
    )

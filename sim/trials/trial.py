"""One simulated trial: one scan of a scene, a decision of each stack from it, and the picks in two twins."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass, replace
from enum import StrEnum
from pathlib import Path
from typing import Any

import numpy as np

from splatbot.collision import RobotSpheres
from splatbot.errors import SplatbotError
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.affordance import AffordanceError, Target
from splatbot.grasping.pick import Picker
from splatbot.grasping.pick_types import PickOutcome, PickResult, PickStage
from splatbot.planning import certify_motion
from splatbot.planning.follow import follow
from splatbot.protocols import Array
from splatbot.sim.camera import TwinCamera
from splatbot.sim.compare.held_out import HeldOutTwin, Spread, draw
from splatbot.sim.contact_monitor import ContactMonitor
from splatbot.sim.controller import TwinController
from splatbot.sim.dressing import dressed
from splatbot.sim.picking import push_aside
from splatbot.sim.trials.scan import TrialScan, UnseenError, scan_scene
from splatbot.sim.trials.scenes import TABLE, TrialScene
from splatbot.sim.trials.shake import Shake
from splatbot.sim.trials.stacks import OPTIONS, Stack, StackDecision, StackMap, choose
from splatbot.sim.twin import Twin
from splatbot.sim.video import Video
from splatbot.sim.world import OBJECT
from splatbot.sim.wrist_camera import TwinWristCamera


@dataclass(frozen=True)
class TrialConstants:
    """Constants of the success of a pick."""

    min_rise: float = 0.15
    """Lift [m] that success requires. A smaller one counts objects that are only tilted."""
    min_kept_height: float = 0.12
    """Height [m] over the start that success requires after shaking. It permits a slip of 3 cm in the fingers."""
    target_tolerance: float = 0.04
    """Largest distance [m] between the centres of the target and the found object. A larger one misses that another
    object was taken."""
    contact_period: int = 5
    """Number of control periods [1] between checks for contacts. A larger one is faster and misses short contacts."""


CONSTANTS = TrialConstants()

VERSION = 2
"""Version of scenes and physics of trials. A change that gives a seed another scene or twin increases it."""

HELD_OUT = Spread(impratio=(3.0, 30.0))
"""Physics of the held-out twin. The ranges were chosen before any trial ran with them."""


Watch = Callable[[Any, float], None]


class Failure(StrEnum):
    """Why a trial failed."""

    PERCEPTION = "perception"  # the clicked object was not found, or confused with another
    GRASP = "grasp"  # no grasp fits, or the fingers closed without contact
    IK = "ik"  # grasps fit, but the arm cannot reach them
    PLAN = "plan"  # no path was found
    SLIP = "slip"  # the object was held, and fell
    COLLISION = "collision"  # another object was in contact before
    LOOK = "look"  # the look from the wrist did not find the target, or found the way obstructed
    CONTROL = "control"  # the arm did not follow the motion


@dataclass(frozen=True)
class TwinPickResult:
    """A pick in one twin.

    Args:
        success: lifted and still held after shaking.
        failure: of :class:`Failure`, empty after success.
        outcome: of the pick; "dropped" if the object was lost during shaking.
        reason: description of the failure.
        rose: height by which the target was lifted [m].
        kept: height over its start after shaking [m].
        touched: objects other than the target with which the arm had contact.
        opening: of the fingers on the target [m]. If None, they did not reach it.
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
    """Result of a stack in one scene.

    Args:
        seed, family, stack: of the trial.
        kind: of the target.
        moving: whether an obstacle moved through the scene.
        ideal: in the twin of the scene as described.
        held_out: in a held-out twin with other friction, masses, gains and delays, and all effects.
        plan_ms: time of the path search [ms]. If None, there was no search.
        grasp_ms: time until the ranked list of grasps [ms].
        build_s: time to build the stack's map from the frames, mapping included [s]. If None, no map was built.
        world_bytes: size of that map [bytes], or None without one.
        width_mm: of the grasp [mm]. If None, there was no grasp.
        frames, pixels: number of frames of the scan, and their width [px].
        moved: distance by which the target was pushed aside after the scan [m].
        version: of scenes and physics, :data:`VERSION`. Rows of another one are no results of these trials.
    """

    seed: int
    family: str
    stack: str
    kind: str
    moving: bool
    ideal: TwinPickResult
    held_out: TwinPickResult
    plan_ms: float | None
    grasp_ms: float | None
    build_s: float | None
    world_bytes: int | None
    width_mm: float | None
    frames: int
    pixels: int
    moved: float = 0.0
    version: int = 1

    def to_dict(self) -> dict[str, Any]:
        """Return the row as values for JSON; the held-out twin is ``reality`` there."""
        values = asdict(self)
        return values | {"reality": values.pop("held_out")}

    @classmethod
    def from_dict(cls, values: dict[str, Any]) -> TrialRow:
        """Create a row from the values of :meth:`to_dict`."""
        values = {**values}
        values["held_out"] = values.pop("reality")
        twins = {
            name: TwinPickResult(**{**values[name], "touched": tuple(values[name]["touched"])})
            for name in ("ideal", "held_out")
        }
        return cls(**{**values, **twins})


def run_trial(
    trial: TrialScene,
    stacks: Sequence[Stack],
    *,
    frames: int = 32,
    width: int = 320,
    videos: Path | None = None,
    moved: float = 0.0,
) -> list[TrialRow]:
    """Scan a scene, and let each stack pick its target. A target that no image shows is a failure of each stack.

    Args:
        trial: the scene.
        stacks: the stacks.
        frames, width: of the scan, see :func:`splatbot.sim.trials.scan.scan_scene`.
        videos: folder for videos of picks that failed in the held-out twin. If None, no videos are recorded.
        moved: distance by which the target is pushed aside after the scan [m].
    """
    try:
        seen = scan_scene(trial, frames=frames, width=width, calibrated=False)
    except UnseenError as error:
        both = _no_target(error)
        rows = [_row(stack, trial, (frames, width), None, None, None, both, both) for stack in stacks]
        return [replace(row, moved=moved) for row in rows]
    return [replace(pick_with(stack, trial, seen, videos=videos, moved=moved), moved=moved) for stack in stacks]


def pick_with(
    stack: Stack, trial: TrialScene, seen: TrialScan, *, videos: Path | None = None, moved: float = 0.0
) -> TrialRow:
    """Run one stack's pick from a scan in both twins."""
    known = stack.learn(seen)
    scan = len(seen.frames), seen.frames[0].camera.width
    try:
        trial, decision = choose(known, trial, seen, looks=stack.looks)
    except AffordanceError as error:
        both = _no_target(error)
        return _row(stack, trial, scan, known, None, None, both, both)
    results = []
    mistaken = _mistaken(known, decision.target, trial)
    for twin in (Twin(trial.scene), held_out_twin(trial)):
        results.append(attempt(decision, trial, twin, mistaken=mistaken, moved=moved))
    (ideal, first), (held_out, last) = results
    if videos is not None and not held_out.success and last.motions:  # an arm that did not move shows nothing
        _film(decision, trial, videos / f"{trial.family}-{trial.seed}-{stack.name}.mp4", moved)
    return _row(stack, trial, scan, known, decision, first, ideal, held_out)


def attempt(
    decision: StackDecision,
    trial: TrialScene,
    twin: Twin,
    *,
    mistaken: bool = False,
    moved: float = 0.0,
    watch: Watch | None = None,
) -> tuple[TwinPickResult, PickResult]:
    """Run the pick in a twin, then shake.

    Args:
        decision: target, grasps and planner.
        trial: the scene.
        twin: of it.
        mistaken: whether the decision is about another object than the trial's target.
        moved: distance by which the target is pushed aside first [m].
        watch: called with MuJoCo's data and the time [s] after every control period.
    """
    if moved > 0.0:
        push_aside(twin, trial.target, moved, trial.seed)
    controller = _Watched(twin, watch)
    assert controller.gripper is not None
    before = _height(twin, trial.target)
    parts = (decision.sampler, controller, controller.gripper)
    if decision.looks:
        camera = TwinWristCamera(twin, T_world_base=decision.sampler.scene.T_world_base, seed=trial.seed)
        picker = Picker(*parts, options=OPTIONS, camera=camera)
    else:
        picker = Picker(*parts, options=OPTIONS, make_planner=lambda target: decision.planner)
    result = picker.pick(decision.target, grasps=decision.grasps)
    rose = _height(twin, trial.target) - before
    early = controller.touched(trial.target)
    kept, shaken = rose, ""
    if result and result.q is not None:
        try:
            shake = Shake(decision.sampler.robot.chain, result.q).motion()
            done = follow(controller, certify_motion(shake, RobotSpheres(decision.sampler.robot), None))
            shaken = "" if done else done.fault or f"the arm ended {done.state}"
        except SplatbotError as error:
            shaken = error.message
        kept = _height(twin, trial.target) - before
    success = bool(result) and rose >= CONSTANTS.min_rise and kept >= CONSTANTS.min_kept_height
    outcome, reason = str(result.outcome), result.reason
    if result and not success:
        outcome = "dropped" if rose >= CONSTANTS.min_rise else "lost"
        reason = shaken or f"rose {1e3 * rose:.0f} mm, {1e3 * kept:.0f} mm after it was shaken"
    failure = "" if success else _failure(result, early, mistaken)
    touched = controller.touched(trial.target)
    return TwinPickResult(success, failure, outcome, reason, rose, kept, touched, result.opening), result


class _Watched(TwinController):
    """A twin's controller that records the contacts of its arm."""

    def __init__(self, twin: Twin, watch: Watch | None) -> None:
        self._contacts, self._periods = ContactMonitor(twin.world), 0
        super().__init__(twin, watch=watch)

    def _advance(self, q: Array, velocity: Array, acceleration: Array) -> None:
        super()._advance(q, velocity, acceleration)
        self._periods += 1
        if self._periods % CONSTANTS.contact_period == 0:
            self._contacts.update(self.twin.data, self._clock)

    def touched(self, target: str) -> tuple[str, ...]:
        """Return the objects other than the target with which the arm had contact."""
        names = {obj.name for obj in self.twin.scene.objects} - {target}
        return tuple(sorted({contact.other for contact in self._contacts.found} & names))


def held_out_twin(trial: TrialScene) -> HeldOutTwin:
    """Return the twin of a scene with other friction, masses, gains, delays and engine settings, and all effects."""
    return HeldOutTwin(trial.scene, draw(HELD_OUT, trial.seed))


def _film(decision: StackDecision, trial: TrialScene, path: Path, moved: float) -> None:
    """Record the pick in the held-out twin again, with a camera."""
    twin = held_out_twin(trial)
    video = Video(path, TwinCamera(dressed(twin.world), seed=trial.seed))
    try:
        attempt(decision, trial, twin, moved=moved, watch=video)
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
    if result.outcome in (PickOutcome.TARGET_MOVED, PickOutcome.OBSTRUCTED):
        return Failure.LOOK
    if result.outcome is PickOutcome.NOTHING_HELD:
        return Failure.GRASP
    if result.outcome is PickOutcome.LOST or result.outcome is PickOutcome.PICKED:
        return Failure.SLIP
    late = (PickStage.LIFT, PickStage.CHECK)
    return Failure.COLLISION if touched and result.stage not in late else Failure.CONTROL


def _mistaken(known: StackMap, target: Target, trial: TrialScene) -> bool:
    """Return whether the found object is not at the target's position."""
    points = known.scene.model.means.detach().double().numpy()[target.rows]
    found = transform_points(inverse(known.scene.T_world_base), points)
    middle = (found.min(axis=0) + found.max(axis=0))[:2] / 2
    true = next(np.asarray(obj.at) for obj in trial.scene.objects if obj.name == trial.target)
    return bool(np.linalg.norm(middle - true[:2]) > CONSTANTS.target_tolerance)


def _no_target(error: SplatbotError) -> TwinPickResult:
    return TwinPickResult(False, Failure.PERCEPTION, "no target", error.message)


def _height(twin: Twin, name: str) -> float:
    return float(twin.data.body(OBJECT + name).xipos[2])


def _row(
    stack: Stack,
    trial: TrialScene,
    scan: tuple[int, int],
    known: StackMap | None,
    decision: StackDecision | None,
    result: PickResult | None,
    ideal: TwinPickResult,
    held_out: TwinPickResult,
) -> TrialRow:
    planned = None if result is None or result.planning_seconds is None else 1e3 * result.planning_seconds
    return TrialRow(
        seed=trial.seed,
        family=trial.family,
        stack=stack.name,
        kind=trial.kind,
        moving=trial.moving,
        ideal=ideal,
        held_out=held_out,
        plan_ms=planned,
        grasp_ms=None if decision is None else 1e3 * decision.seconds,
        build_s=None if known is None else known.seconds,
        world_bytes=None if known is None else known.world_bytes,
        width_mm=None if result is None or result.grasp is None else 1e3 * result.grasp.width,
        frames=scan[0],
        pixels=scan[1],
        version=VERSION,
    )

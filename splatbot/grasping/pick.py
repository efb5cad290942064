"""Picking: sample grasps, certify a complete plan, then execute its stages."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from splatbot.errors import GripperError, InputError, SplatbotError
from splatbot.grasping.affordance import Target
from splatbot.grasping.hands import Hands
from splatbot.grasping.look import CONSTANTS as LOOK
from splatbot.grasping.look import WristCamera, in_the_way, relocate, share_gone, unexplained
from splatbot.grasping.moved_target import with_obstacles
from splatbot.grasping.pick_planner import MapPickPlanner, PickPlan, PickPlanner, Segment
from splatbot.grasping.pick_types import PickMotion, PickOptions, PickOutcome, PickResult, PickStage, PickStep
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.types import Grasp, GraspResult, NoGraspError
from splatbot.planning import JointGoal, certify_motion, time_path
from splatbot.planning.follow import follow
from splatbot.protocols import Array, Controller, Feedback, Gripper, MotionState

_SETTLE_S = 6.0  # [s] after which moving fingers are an error
_MOVING_NOTE = "no plan avoids the regions where motion was observed; this plan crosses one"


class _EndedError(Exception):
    """Ends the pick in the current stage."""

    def __init__(self, outcome: PickOutcome, reason: str, error: SplatbotError | None = None) -> None:
        self.outcome, self.reason, self.error = outcome, reason, error
        super().__init__(reason)


class _MissedError(_EndedError):
    """Ends an attempt after which the next grasp may be tried; ``back`` leads to the pre-grasp, if it is not there."""

    def __init__(self, outcome: PickOutcome, reason: str, back: Segment | None = None) -> None:
        super().__init__(outcome, reason)
        self.back = back


class Picker:
    """Picks objects of one state of the map.

    All segments are certified before the arm moves: the path to the pre-grasp, the straight approach and the straight
    lift. On the lift the object is part of the arm as attached spheres. Any failure ends the pick and stops the arm.
    Fingers that hold an object keep it; fingers that closed without an object open again.

    With a wrist camera the loop is closed. At the pre-grasp the arm looks again. If the target moved by up to 5 cm, it
    plans to the new place. If something is in the way, that becomes an obstacle, and the next grasp is tried. After the
    lift it looks whether the place is empty. If the fingers hold nothing, or something of another width, it goes back
    and tries the next grasp.

    Args:
        sampler: grasp sampler with the map, the robot and its base pose.
        controller: controller of the arm.
        gripper: the gripper.
        options: options of the pick.
        stop: polled in every control period; the pick ends if it returns True.
        on_step: called after each completed stage.
        make_planner: returns the planner of a target. If None, a
            :class:`splatbot.grasping.pick_planner.MapPickPlanner` is used.
        camera: the arm's wrist camera. If None, the arm does not observe the scene, and one grasp is executed.

    Raises:
        InputError: a wrist camera and another planner are given, because only that of the map follows a moved target.
        InputError: a wrist camera is given and the sampler agrees with plans, whose obstacles do not follow the target.
        InputError: the stroke of the gripper is smaller than that of the robot's hand model.
    """

    def __init__(
        self,
        sampler: GraspSampler,
        controller: Controller,
        gripper: Gripper,
        *,
        options: PickOptions | None = None,
        stop: Callable[[], bool] | None = None,
        on_step: Callable[[PickStep], None] | None = None,
        make_planner: Callable[[Target], PickPlanner] | None = None,
        camera: WristCamera | None = None,
    ) -> None:
        if camera is not None and make_planner is not None:
            hint = "leave make_planner out"
            raise InputError("needs the planner of the map.", field="camera", hint=hint)
        if camera is not None and sampler.departure is not None:
            hint = "leave the camera out, or do not call agree_with_plans"
            raise InputError("has obstacles of plans, which do not follow a target.", field="sampler", hint=hint)
        if gripper.stroke < sampler.hand.stroke - 1e-6:
            text = f"opens {gripper.stroke:g} m, the hand of the robot {sampler.hand.stroke:g} m."
            raise InputError(text, field="gripper", hint="give the robot that has this gripper")
        self.sampler, self.controller, self.gripper = sampler, controller, gripper
        self.options = options or PickOptions()
        self._stop, self._on_step, self.camera = stop, on_step, camera
        self.make_planner = make_planner or (lambda target: MapPickPlanner(sampler, target, self.options))

    def pick(self, target: Target, *, grasps: GraspResult | None = None) -> PickResult:
        """Grasp a target and lift it.

        Args:
            target: the target.
            grasps: grasps that were sampled before. If None, they are sampled.

        Raises:
            InputError: the target has no Gaussians.
        """
        return _Pick(self, target).run(grasps)


class _Pick:
    """State and stages of one pick."""

    def __init__(self, picker: Picker, target: Target) -> None:
        self.p, self.o, self.target = picker, picker.options, target
        self.s, self.controller, self.gripper = picker.sampler, picker.controller, picker.gripper
        self.steps: list[PickStep] = []
        self.stage = PickStage.GRASP
        self.grasp: Grasp | None = None
        self.opening: float | None = None
        self.attached: Array | None = None
        self.q: Array | None = None
        self.planning_seconds: float | None = None
        self.notes: list[str] = []
        self.motions: list[PickMotion] = []
        self.left: list[tuple[int, Grasp]] = []
        self.T_now_mapped = np.eye(4)
        self.attempts, self.shift = 0, None if picker.camera is None else 0.0
        self._began = time.perf_counter()

    def run(self, grasps: GraspResult | None) -> PickResult:
        try:
            found = grasps or self.s.sample(self.target, self.o.grasp)
            if not found.grasps:
                raise _EndedError(PickOutcome.NO_GRASP, NoGraspError(found).message)
            self._done("1 grasp" if len(found.grasps) == 1 else f"{len(found.grasps)} grasps")
            self.left = list(enumerate(found.grasps, start=found.first_rank))
            self._try_in_turn()
        except _EndedError as end:
            return self._ended(end)
        except GripperError as error:
            return self._ended(_EndedError(PickOutcome.GRIPPER_FAILED, error.message, error))
        except SplatbotError as error:
            if isinstance(error, InputError):
                raise
            return self._ended(_EndedError(PickOutcome.NOT_FOLLOWED, error.message, error))
        return self._result(PickOutcome.PICKED, "")

    def _try_in_turn(self) -> None:
        """Execute grasps until one holds the object, each after the failure of the one before."""
        self.planner = self.p.make_planner(self.target)
        while True:
            plan = self._plan()
            self.attempts += 1
            try:
                return self._execute(plan)
            except _MissedError as miss:
                if self.p.camera is None or self.attempts >= self.o.attempts or not self.left:
                    raise
                self._done(f"{miss.outcome}: {miss.reason}; the next grasp is tried")
                if miss.back is not None:
                    self._follow(PickStage.APPROACH, miss.back, self.o.slow, plan.opening)

    def _plan(self) -> PickPlan:
        """Plan to the grasps in order of their score, and return the first plan that is found; the rest is left."""
        self.stage = PickStage.PLAN
        start = self.controller.step().position
        candidates = self.left[: self.o.tries]
        attempts = [(k, grasp, grasp.avoids_moving and self.s.moving is not None) for k, grasp in candidates]
        attempts += [(k, grasp, False) for k, grasp, avoid_moving in attempts if avoid_moving]
        reasons: dict[str, list[int]] = {}
        for k, grasp, avoid_moving in attempts:
            plan = self._plan_to(grasp, start, avoid_moving)
            if isinstance(plan, PickPlan):
                self.left = [(number, each) for number, each in self.left if number > k]
                self.grasp, self.planning_seconds = plan.grasp, plan.planning_seconds
                self._note_moving(plan)
                self._done(f"grasp {k}, {grasp.approach}; {1e3 * plan.clearance:.1f} mm minimum clearance")
                return plan
            reasons.setdefault(plan, []).append(k)
        named = (f"grasp {', '.join(str(k) for k in dict.fromkeys(ranks))}: {why}" for why, ranks in reasons.items())
        raise _EndedError(PickOutcome.NO_PLAN, "; ".join(named))

    def _plan_to(self, grasp: Grasp, start: Array, avoid_moving: bool) -> PickPlan | str:
        """Plan to a grasp of the target where the latest look found it; return the reason without a plan."""
        if not np.array_equal(self.T_now_mapped, np.eye(4)):
            assert isinstance(self.planner, MapPickPlanner)  # only a look moves a target
            moved = self.planner.moved(grasp, self.T_now_mapped)
            if moved is None:
                return "the arm does not reach it at the target's new place"
            grasp = moved
        return self.planner.plan_to(grasp, start, avoid_moving=avoid_moving)

    def _note_moving(self, plan: PickPlan | Segment) -> None:
        """Append a note if a plan crosses regions where motion was observed."""
        if not plan.avoids_moving:
            self.notes.append(f"{self.stage}: {_MOVING_NOTE}")

    def _execute(self, plan: PickPlan) -> None:
        self.stage = PickStage.OPEN
        self.gripper.move(plan.opening)
        self._settle()
        self._done(f"{1e3 * self.gripper.opening():.0f} mm")
        self._follow(PickStage.MOVE, plan.to_pregrasp, 1.0, plan.opening)
        if self.p.camera is not None:
            plan = self._look(self.p.camera, plan)
        self._follow(PickStage.APPROACH, plan.approach, self.o.slow, plan.opening)
        self._close(plan)
        self._follow(PickStage.LIFT, plan.lift_off, self.o.slow, plan.grasp.width)
        self._follow(PickStage.LIFT, plan.lift, self.o.slow, plan.grasp.width)
        self._check(plan)
        if self.o.carry_to is not None:
            self._carry(plan)

    def _look(self, camera: WristCamera, plan: PickPlan) -> PickPlan:
        """Look at the target from the pre-grasp; return the plan to where it is now."""
        self.stage = PickStage.LOOK
        view = camera.look()
        surface = self.s.surface(self.target)
        found, gone = relocate(self.s.scene, surface, view), share_gone(surface.points, view)
        if not found.shown and (gone is None or gone < LOOK.min_gone):  # another grasp may look from another side
            raise _MissedError(PickOutcome.TARGET_MOVED, found.reason)
        if found.reason:
            raise _EndedError(PickOutcome.TARGET_MOVED, found.reason)
        self.shift = found.shift
        agrees = f"{100 * found.share:.0f} % of {found.points} points agree"
        if not found.still:
            self._done(f"moved by {1e3 * found.shift:.1f} mm, {np.degrees(found.turn):.1f} degrees; {agrees}")
            plan = self._adjusted(plan, found.T_now_before)
        retreat = plan.grasp.approach_length
        hand = Hands.one(plan.grasp.T_world_tcp, plan.opening)
        deep = in_the_way(hand, self.s.hand, view, retreat)
        if deep > LOOK.max_penetration:
            balls = unexplained(self.s.scene, self.s.field, view)
            self.s = with_obstacles(self.s, balls)
            self.planner = MapPickPlanner(self.s, self.target, self.o)
            reason = f"depth is {1e3 * deep:.1f} mm deep in the hand on its way; {len(balls)} obstacles are new"
            raise _MissedError(PickOutcome.OBSTRUCTED, reason)
        if found.still:
            self._done(f"in its place; {agrees}")
        return plan

    def _adjusted(self, plan: PickPlan, T_now_before: Array) -> PickPlan:
        """Move to the pre-grasp at the target's new place."""
        self.stage = PickStage.ADJUST
        here = self.controller.step().position
        assert isinstance(self.planner, MapPickPlanner)
        adjusted = self.planner.adjusted(plan, T_now_before, self.target, here)
        if isinstance(adjusted, str):
            raise _MissedError(PickOutcome.NO_PLAN, adjusted)
        self.s, self.planner, self.grasp = adjusted.sampler, adjusted.planner, adjusted.plan.grasp
        self.T_now_mapped = T_now_before @ self.T_now_mapped
        self._follow(PickStage.ADJUST, adjusted.plan.to_pregrasp, self.o.slow, plan.opening)
        return adjusted.plan

    def _close(self, plan: PickPlan) -> None:
        self.stage = PickStage.CLOSE
        self.gripper.move(0.0, force=self.o.force)
        self._settle()
        self.opening = self.gripper.opening()
        if not self.gripper.holds():
            self._open_again(plan)
            reason = "the fingers closed without an object and opened again"
            raise _MissedError(PickOutcome.NOTHING_HELD, reason, _reversed(plan.approach))
        wide, expected = f"{1e3 * self.opening:.1f} mm", f"{1e3 * plan.grasp.width:.1f} mm expected"
        if self.p.camera is not None and abs(self.opening - plan.grasp.width) > self.o.width_tolerance:
            self._open_again(plan)
            reason = f"the fingers stopped at {wide}, {expected}, and opened again"
            raise _MissedError(PickOutcome.UNEXPECTED_WIDTH, reason, _reversed(plan.approach))
        self.attached = plan.attached
        self._done(f"{wide} between the fingers, {expected}")

    def _open_again(self, plan: PickPlan) -> None:
        self.gripper.move(plan.opening)
        if self.p.camera is not None:  # another attempt follows
            self._settle()

    def _check(self, plan: PickPlan) -> None:
        """Check by the fingers, and by the camera, that the object left its place."""
        self.stage = PickStage.CHECK
        if not self.gripper.holds():
            self.attached = None
            if self.p.camera is not None:
                self._open_again(plan)
            raise _MissedError(PickOutcome.LOST, "the object is no longer between the fingers")
        note = f"{1e3 * self.gripper.opening():.1f} mm between the fingers"
        if self.p.camera is not None:
            gone = share_gone(self.s.surface(self.target).points, self.p.camera.look())
            if gone is not None and gone < LOOK.min_gone:
                reason = f"only {100 * gone:.0f} % of its place is empty, so the fingers hold something else"
                raise _EndedError(PickOutcome.LOST, reason)
            note += "; its place is hidden" if gone is None else f"; {100 * gone:.0f} % of its place is empty"
        self._done(note)

    def _carry(self, plan: PickPlan) -> None:
        """Carry the object to ``PickOptions.carry_to`` on a path that is planned with the attached object."""
        self.stage = PickStage.CARRY
        assert self.o.carry_to is not None
        assert self.q is not None
        segment = self.planner.plan_carry(plan, self.q, JointGoal(self.o.carry_to))
        if not isinstance(segment, Segment):
            raise _EndedError(PickOutcome.NO_PLAN, segment)
        self._note_moving(segment)
        self._follow(PickStage.CARRY, segment, self.o.slow, plan.grasp.width)
        if not self.gripper.holds():
            self.attached = None
            raise _EndedError(PickOutcome.LOST, "the object is no longer between the fingers")

    def _follow(self, stage: PickStage, segment: Segment, factor: float, opening: float) -> None:
        self.stage = stage
        scale = self.o.speed * factor
        trajectory = time_path(
            segment.path, segment.arm, segment.around, velocity_scale=scale, acceleration_scale=scale
        )
        if not trajectory.certificate.certified:
            raise _EndedError(PickOutcome.NO_PLAN, "the timed trajectory is not certified as free")
        motion = certify_motion(trajectory, segment.arm, segment.around)
        for guard in segment.guards:
            certify_motion(trajectory, guard.links, guard.field)
        self.motions.append(PickMotion(stage, trajectory, opening))
        done = follow(self.controller, motion, stop=self._stop_requested)
        self.q = trajectory.end
        if done.state is MotionState.STOPPED and self._stop_requested(None):
            raise _EndedError(PickOutcome.STOPPED, "a stop was requested")
        if not done:
            raise _EndedError(PickOutcome.NOT_FOLLOWED, done.fault or f"the arm ended {done.state}")
        self._done(f"{trajectory.duration:.2f} s of motion, tracking error at most {1e3 * done.error.max():.1f} mrad")

    def _settle(self) -> None:
        """Wait until the fingers rest; the timeout must expire on both the controller's clock and the wall clock."""
        until, periods = time.monotonic() + _SETTLE_S, int(_SETTLE_S / self.controller.period)
        while self.gripper.moving():
            if self._stop_requested(None):
                self.gripper.stop()
                raise _EndedError(PickOutcome.STOPPED, "a stop was requested")
            if self.controller.step().state is MotionState.FAULT:
                raise _EndedError(PickOutcome.NOT_FOLLOWED, "the controller reports a fault")
            periods -= 1
            if periods < 0 and time.monotonic() > until:
                self.gripper.stop()
                raise _EndedError(PickOutcome.GRIPPER_FAILED, f"the fingers still move after {_SETTLE_S:g} s")

    def _stop_requested(self, feedback: Feedback | None) -> bool:
        return self.p._stop is not None and self.p._stop()

    def _done(self, note: str) -> None:
        now = time.perf_counter()
        self.steps.append(PickStep(self.stage, now - self._began, note))
        self._began = now
        if self.p._on_step is not None:
            self.p._on_step(self.steps[-1])

    def _ended(self, end: _EndedError) -> PickResult:
        """Stop the arm, leave the fingers as they are, and return the result."""
        self.controller.stop()
        self.controller.step()
        self._done(end.reason)
        return self._result(end.outcome, end.reason, end.error)

    def _result(self, outcome: PickOutcome, reason: str, error: SplatbotError | None = None) -> PickResult:
        return PickResult(
            outcome, self.stage, reason, self.grasp, tuple(self.steps), self.opening, self.attached, self.q, error,
            self.planning_seconds, tuple(self.notes), self.attempts, self.shift, tuple(self.motions),
        )  # fmt: skip


def _reversed(segment: Segment) -> Segment:
    """Return the way back, which has the same certificate."""
    return replace(segment, path=replace(segment.path, waypoints=segment.path.waypoints[::-1].copy()))

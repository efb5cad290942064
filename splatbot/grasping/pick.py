"""Picking: a grasp, the whole way to it and back up, certified before anything moves; then each stage in turn."""

from __future__ import annotations

import time
from collections.abc import Callable

from splatbot.errors import GripperError, InputError, SplatbotError
from splatbot.grasping.affordance import Target
from splatbot.grasping.pick_planner import MapPickPlanner, PickPlan, PickPlanner, Segment
from splatbot.grasping.pick_types import PickOptions, PickOutcome, PickResult, PickStage, PickStep
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.types import Grasp, GraspResult, NoGraspError
from splatbot.planning import JointGoal, time_path
from splatbot.planning.follow import follow
from splatbot.protocols import Array, Controller, Feedback, Gripper, MotionState

_SETTLE = 6.0  # [s] in which fingers must come to rest
_NOT_CLEAR = "no way was found that keeps clear of where something moved; this one does not"


class _EndedError(Exception):
    """A stage that the pick ends in."""

    def __init__(self, outcome: PickOutcome, reason: str, error: SplatbotError | None = None) -> None:
        self.outcome, self.reason, self.error = outcome, reason, error
        super().__init__(reason)


class Picker:
    """Picks objects of one state of the map.

    The way to the grasp, the straight approach, and the straight lift with the object as spheres of the hand are all
    certified before the arm moves. Whatever fails ends the pick: the arm is told to stop; fingers that hold something
    keep it, and those that closed on nothing open again.

    Args:
        sampler: of grasps; it has the map, the robot and where it stands.
        controller: of the arm.
        gripper: its fingers.
        options: how.
        stop: asked all the time; True ends the pick.
        on_step: told of each stage that is done.
        make_ways: gives, for a target, who finds the ways to its grasps; by default
            :class:`splatbot.grasping.pick_planner.MapPickPlanner`.

    Raises:
        InputError: the gripper opens less than the robot's hand.
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
        make_ways: Callable[[Target], PickPlanner] | None = None,
    ) -> None:
        if gripper.stroke < sampler.hand.stroke - 1e-6:
            text = f"opens {gripper.stroke:g} m, the hand of the robot {sampler.hand.stroke:g} m."
            raise InputError(text, field="gripper", hint="give the robot that has this gripper")
        self.sampler, self.controller, self.gripper = sampler, controller, gripper
        self.options = options or PickOptions()
        self._stop, self._on_step = stop, on_step
        self.make_ways = make_ways or (lambda target: MapPickPlanner(sampler, target, self.options))

    def pick(self, target: Target, *, grasps: GraspResult | None = None) -> PickResult:
        """Take a target and lift it; ``grasps``: those that are known already.

        Raises:
            InputError: the target has no Gaussians.
        """
        return _Pick(self, target).run(grasps)


class _Pick:
    """One pick: its stages, and what is known so far."""

    def __init__(self, picker: Picker, target: Target) -> None:
        self.p, self.o, self.target = picker, picker.options, target
        self.s, self.controller, self.gripper = picker.sampler, picker.controller, picker.gripper
        self.steps: list[PickStep] = []
        self.stage = PickStage.GRASP
        self.grasp: Grasp | None = None
        self.opening: float | None = None
        self.attached: Array | None = None
        self.q: Array | None = None
        self.planned: float | None = None
        self.notes: list[str] = []
        self._began = time.perf_counter()

    def run(self, grasps: GraspResult | None) -> PickResult:
        try:
            found = grasps or self.s.sample(self.target, self.o.grasp)
            if not found.grasps:
                raise _EndedError(PickOutcome.NO_GRASP, _why_none(found))
            self._done(f"{len(found.grasps)} grasps of {found.candidates} hands")
            way = self._way(found)
            self.grasp, self.planned = way.grasp, way.planned
            self._execute(way)
        except _EndedError as end:
            return self._ended(end)
        except GripperError as error:
            return self._ended(_EndedError(PickOutcome.GRIPPER_FAILED, error.message, error))
        except SplatbotError as error:
            if isinstance(error, InputError):
                raise
            return self._ended(_EndedError(PickOutcome.NOT_FOLLOWED, error.message, error))
        return self._result(PickOutcome.PICKED, "")

    def _way(self, found: GraspResult) -> PickPlan:
        """Of the best grasp that has one."""
        self.stage = PickStage.PLAN
        self.ways = self.p.make_ways(self.target)
        start = self.controller.step().position
        tried = list(enumerate(found.grasps[: self.o.tries], start=1))
        asked = [(k, grasp, grasp.clear and self.s.moving is not None) for k, grasp in tried]
        asked += [(k, grasp, False) for k, grasp, cautious in asked if cautious]
        why: list[str] = []
        for k, grasp, cautious in asked:
            way = self.ways.to(grasp, start, cautious=cautious)
            if isinstance(way, PickPlan):
                self._noted(way)
                self._done(f"grasp {k}, {grasp.approach}; {1e3 * way.room:.1f} mm of room all the way")
                return way
            why.append(f"grasp {k}: {way}")
        raise _EndedError(PickOutcome.NO_WAY, "; ".join(why))

    def _noted(self, way: PickPlan | Segment) -> None:
        """Keep in mind that a way is not clear of where something moved."""
        if not way.clear:
            self.notes.append(f"{self.stage}: {_NOT_CLEAR}")

    def _execute(self, way: PickPlan) -> None:
        self.stage = PickStage.OPEN
        self.gripper.move(way.opening)
        self._settle()
        self._done(f"{1e3 * self.gripper.opening():.0f} mm")
        self._follow(PickStage.MOVE, way.there, 1.0)
        self._follow(PickStage.APPROACH, way.approach, self.o.slow)
        self._close(way)
        self._follow(PickStage.LIFT, way.free, self.o.slow)
        self._follow(PickStage.LIFT, way.lift, self.o.slow)
        self._check()
        if self.o.carry_to is not None:
            self._carry(way)

    def _close(self, way: PickPlan) -> None:
        self.stage = PickStage.CLOSE
        self.gripper.move(0.0, force=self.o.force)
        self._settle()
        self.opening = self.gripper.opening()
        if not self.gripper.holds():
            self.gripper.move(way.opening)
            raise _EndedError(PickOutcome.NOTHING_HELD, "the fingers closed on nothing, and were opened again")
        self.attached = way.attached
        self._done(f"{1e3 * self.opening:.1f} mm between the fingers, {1e3 * way.grasp.width:.1f} mm expected")

    def _check(self) -> None:
        self.stage = PickStage.CHECK
        if not self.gripper.holds():
            self.attached = None
            raise _EndedError(PickOutcome.LOST, "nothing is between the fingers any more")
        self._done(f"{1e3 * self.gripper.opening():.1f} mm between the fingers")

    def _carry(self, way: PickPlan) -> None:
        """To where it was asked for, around everything with what is held."""
        self.stage = PickStage.CARRY
        assert self.o.carry_to is not None
        assert self.q is not None
        leg = self.ways.onwards(way, self.q, JointGoal(self.o.carry_to))
        if not isinstance(leg, Segment):
            raise _EndedError(PickOutcome.NO_WAY, leg)
        self._noted(leg)
        self._follow(PickStage.CARRY, leg, self.o.slow)
        if not self.gripper.holds():
            self.attached = None
            raise _EndedError(PickOutcome.LOST, "nothing is between the fingers any more")

    def _follow(self, stage: PickStage, leg: Segment, share: float) -> None:
        self.stage = stage
        speed = self.o.speed * share
        trajectory = time_path(leg.path, leg.arm, leg.around, velocity_scale=speed, acceleration_scale=speed)
        if not trajectory.certificate.certified:
            raise _EndedError(PickOutcome.NO_WAY, "the timed way is not free")
        done = follow(self.controller, trajectory, stop=self._asked)
        self.q = trajectory.end
        if done.state is MotionState.STOPPED and self._asked(None):
            raise _EndedError(PickOutcome.STOPPED, "it was told to stop")
        if not done:
            raise _EndedError(PickOutcome.NOT_FOLLOWED, done.fault or f"the arm ended {done.state}")
        self._done(f"{trajectory.duration:.2f} s of motion, {1e3 * done.error.max():.1f} mrad off at most")

    def _settle(self) -> None:
        """Let time pass until the fingers rest: by the controller's clock, and by the wall's where that is behind."""
        until, periods = time.monotonic() + _SETTLE, int(_SETTLE / self.controller.period)
        while self.gripper.moving():
            if self._asked(None):
                self.gripper.stop()
                raise _EndedError(PickOutcome.STOPPED, "it was told to stop")
            if self.controller.step().state is MotionState.FAULT:
                raise _EndedError(PickOutcome.NOT_FOLLOWED, "the controller is at fault")
            periods -= 1
            if periods < 0 and time.monotonic() > until:
                self.gripper.stop()
                raise _EndedError(PickOutcome.GRIPPER_FAILED, f"the fingers still move after {_SETTLE:g} s")

    def _asked(self, feedback: Feedback | None) -> bool:
        return self.p._stop is not None and self.p._stop()

    def _done(self, note: str) -> None:
        now = time.perf_counter()
        self.steps.append(PickStep(self.stage, now - self._began, note))
        self._began = now
        if self.p._on_step is not None:
            self.p._on_step(self.steps[-1])

    def _ended(self, end: _EndedError) -> PickResult:
        """The arm at rest; fingers as they are."""
        self.controller.stop()
        self.controller.step()
        self._done(end.reason)
        return self._result(end.outcome, end.reason, end.error)

    def _result(self, outcome: PickOutcome, reason: str, error: SplatbotError | None = None) -> PickResult:
        return PickResult(
            outcome, self.stage, reason, self.grasp, tuple(self.steps), self.opening, self.attached, self.q, error,
            self.planned, tuple(self.notes),
        )  # fmt: skip


def _why_none(found: GraspResult) -> str:
    return NoGraspError(found).message

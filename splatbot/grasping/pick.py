"""Picking: a grasp, the whole way to it and back up, certified before anything moves; then each stage in turn."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import torch
from numpy.typing import ArrayLike

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import GripperError, InputError, SplatbotError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.affordance import Target
from splatbot.grasping.hands import OPENINGS
from splatbot.grasping.held import covering_spheres
from splatbot.grasping.obstacles import around_target
from splatbot.grasping.pick_types import PickOptions, PickOutcome, PickResult, PickStage, PickStep
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.surface import target_surface
from splatbot.grasping.types import Grasp, GraspResult, NoGraspError
from splatbot.planning import GaussianRRTStar, JointGoal, Path, time_path
from splatbot.planning.cartesian import StraightResult, straight_line
from splatbot.planning.follow import follow
from splatbot.protocols import Array, Controller, Feedback, Gripper, MotionState

_SETTLE = 6.0  # [s] in which fingers must come to rest
_N_SIGMA = 1.0  # of a held object's Gaussians


class _EndedError(Exception):
    """A stage that the pick ends in."""

    def __init__(self, outcome: PickOutcome, reason: str, error: SplatbotError | None = None) -> None:
        self.outcome, self.reason, self.error = outcome, reason, error
        super().__init__(reason)


@dataclass(frozen=True, eq=False)
class _Way:
    """To one grasp and up again, certified."""

    grasp: Grasp
    opening: float
    open_arm: RobotSpheres
    closed_arm: RobotSpheres
    loaded_arm: RobotSpheres
    attached: Array
    there: Path
    approach: Path
    free: Path
    lift: Path


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
    ) -> None:
        if gripper.stroke < sampler.hand.stroke - 1e-6:
            text = f"opens {gripper.stroke:g} m, the hand of the robot {sampler.hand.stroke:g} m."
            raise InputError(text, field="gripper", hint="give the robot that has this gripper")
        self.sampler, self.controller, self.gripper = sampler, controller, gripper
        self.options = options or PickOptions()
        self._stop, self._on_step = stop, on_step
        self._T = sampler.scene.T_world_base

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
        self._began = time.perf_counter()

    def run(self, grasps: GraspResult | None) -> PickResult:
        try:
            found = grasps or self.s.sample(self.target, self.o.grasp)
            if not found.grasps:
                raise _EndedError(PickOutcome.NO_GRASP, _why_none(found))
            self._done(f"{len(found.grasps)} grasps of {found.candidates} hands")
            way = self._way(found)
            self.grasp = way.grasp
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

    def _way(self, found: GraspResult) -> _Way:
        """Of the best grasp that has one."""
        self.stage = PickStage.PLAN
        around = around_target(self.s.scene, self.target.rows)
        self._around, self._beside = self.s.collision_field(around), self._without_strays(around)
        start = self.controller.step().position
        why: list[str] = []
        for k, grasp in enumerate(found.grasps[: self.o.tries]):
            way = self._way_of(grasp, start)
            if isinstance(way, _Way):
                room = min(path.certificate.clearance for path in (way.there, way.approach, way.lift))
                self._done(f"grasp {k + 1}, {grasp.approach}; {1e3 * room:.1f} mm of room all the way")
                return way
            why.append(f"grasp {k + 1}: {way}")
        raise _EndedError(PickOutcome.NO_WAY, "; ".join(why))

    def _way_of(self, grasp: Grasp, start: Array) -> _Way | str:
        """All of it, or what is in the way."""
        if grasp.q is None or grasp.q_pregrasp is None:
            return "no posture is known"
        opening = min(float(np.ceil(grasp.opening / OPENINGS - 1e-6)) * OPENINGS, self.s.hand.stroke)
        planner = GaussianRRTStar(
            self.s.field, self.s.robot, T_world_base=self.p._T, opening=opening, margin=self.s.margin
        )
        plan = planner.plan(start, JointGoal(grasp.q_pregrasp), budget_ms=self.o.budget_ms, seed=self.o.seed)
        if plan.path is None:
            return plan.reason.rstrip(".")
        approach = straight_line(planner.arm, self._around, grasp.q_pregrasp, grasp.T_world_tcp)
        if not approach or approach.path is None:
            return f"its approach is blocked: {approach.reason.rstrip('.')}"
        q = approach.path.waypoints[-1]
        closed = self._arm(grasp.width)
        attached = self._attached(closed, q)
        loaded = self._arm(grasp.width, attached)
        free = self._up(closed, self._beside, q, self.o.free)
        if not free or free.path is None:
            return f"it cannot be lifted: {free.reason.rstrip('.')}"
        lift = self._up(loaded, self._beside, free.path.waypoints[-1], self.o.lift - self.o.free)
        if not lift or lift.path is None:
            return f"it cannot be lifted: {lift.reason.rstrip('.')}"
        return _Way(
            grasp, opening, planner.arm, closed, loaded, attached, plan.path, approach.path, free.path, lift.path
        )

    def _execute(self, way: _Way) -> None:
        self.stage = PickStage.OPEN
        self.gripper.move(way.opening)
        self._settle()
        self._done(f"{1e3 * self.gripper.opening():.0f} mm")
        self._follow(PickStage.MOVE, way.there, way.open_arm, self.s.field, 1.0)
        self._follow(PickStage.APPROACH, way.approach, way.open_arm, self._around, self.o.slow)
        self._close(way)
        self._follow(PickStage.LIFT, way.free, way.closed_arm, self._beside, self.o.slow)
        self._follow(PickStage.LIFT, way.lift, way.loaded_arm, self._beside, self.o.slow)
        self._check()
        if self.o.carry_to is not None:
            self._carry(way)

    def _close(self, way: _Way) -> None:
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

    def _carry(self, way: _Way) -> None:
        """To where it was asked for, around everything with what is held."""
        self.stage = PickStage.CARRY
        assert self.o.carry_to is not None
        assert self.q is not None
        planner = GaussianRRTStar(
            self._beside,
            self.s.robot,
            T_world_base=self.p._T,
            opening=way.grasp.width,
            attached=way.attached,
            margin=self.s.margin,
        )
        plan = planner.plan(self.q, self.o.carry_to, budget_ms=self.o.budget_ms, seed=self.o.seed)
        if plan.path is None:
            raise _EndedError(PickOutcome.NO_WAY, plan.reason)
        self._follow(PickStage.CARRY, plan.path, planner.arm, self._beside, self.o.slow)
        if not self.gripper.holds():
            self.attached = None
            raise _EndedError(PickOutcome.LOST, "nothing is between the fingers any more")

    def _follow(
        self, stage: PickStage, path: Path, arm: RobotSpheres, around: GaussianCollisionField, share: float
    ) -> None:
        self.stage = stage
        speed = self.o.speed * share
        trajectory = time_path(path, arm, around, velocity_scale=speed, acceleration_scale=speed)
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

    def _arm(self, opening: float, attached: ArrayLike | None = None) -> RobotSpheres:
        return RobotSpheres(
            self.s.robot, T_world_base=self.p._T, opening=opening, attached=attached, margin=self.s.margin
        )

    def _without_strays(self, around: GaussianModel) -> GaussianCollisionField:
        """What is around the target, less what is within it: its own strays, which segmentation has left out."""
        surface = target_surface(self.s.scene, self.target.rows, observers=self.s.observers)
        reach = np.where(surface.seen, 0.0, surface.spread) + _N_SIGMA * surface.doubt
        self._object = covering_spheres(surface.points, reach)
        means = around.means.detach().double().numpy()
        away = np.full(len(means), np.inf)
        for sphere in self._object:
            away = np.minimum(away, np.linalg.norm(means - sphere[:3], axis=1) - sphere[3])
        return self.s.collision_field(around.select(torch.from_numpy(away > 0.0)))

    def _attached(self, arm: RobotSpheres, q: Array) -> Array:
        """The object (A, 4) in the frame of the last link, the arm being at the grasp ``q`` (J,)."""
        T_link_world = inverse(arm.forward(q[None])[0, -1])
        return np.c_[transform_points(T_link_world, self._object[:, :3]), self._object[:, 3]]

    def _up(self, arm: RobotSpheres, around: GaussianCollisionField, q: Array, by: float) -> StraightResult:
        tool = np.asarray(self.s.robot.T_link_tcp, dtype=np.float64)  # type: ignore[attr-defined]
        T = arm.forward(q[None])[0, -1] @ tool
        T[:3, 3] += by * self.s.scene.up
        return straight_line(arm, around, q, T)

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
            outcome, self.stage, reason, self.grasp, tuple(self.steps), self.opening, self.attached, self.q, error
        )


def _why_none(found: GraspResult) -> str:

    return NoGraspError(found).message

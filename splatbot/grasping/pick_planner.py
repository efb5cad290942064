"""Plans of a pick: transit to the pre-grasp, approach, lift-off and lift, all certified before the arm moves."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.grasping.affordance import Target
from splatbot.grasping.hands import CONSTANTS as HANDS
from splatbot.grasping.lift import Lift, lift_target, target_spheres
from splatbot.grasping.moved_target import moved_grasp, moved_sampler
from splatbot.grasping.obstacles import Surfaces, around_target, rows_around, rows_without_strays
from splatbot.grasping.pick_types import PickOptions
from splatbot.grasping.reach import LinkGuard, link_guards
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.types import Grasp
from splatbot.planning import GaussianRRTStar, JointGoal, Path, PoseGoal
from splatbot.planning.cartesian import straight_line
from splatbot.planning.goals import goal_configurations
from splatbot.protocols import Array


@dataclass(frozen=True, eq=False)
class Segment:
    """A certified segment of a pick plan.

    Args:
        path: joint path.
        arm: spheres of the arm and of an attached object.
        around: field against which rounded corners of the path are certified. If None, the planner checks collisions
            by other means and the corners are not certified.
        avoids_moving: whether the path avoids the regions where motion was observed; True without such regions.
        guards: further obstacles, against which the executed curve is certified too.
    """

    path: Path
    arm: RobotSpheres
    around: GaussianCollisionField | None
    avoids_moving: bool = True
    guards: tuple[LinkGuard, ...] = ()


@dataclass(frozen=True, eq=False)
class PickPlan:
    """Plan of a pick: all segments from the start to the lifted object.

    Args:
        grasp: the grasp to execute.
        opening: finger opening until the grasp [m].
        attached: (A, 4) spheres (x, y, z, radius) [m] of the attached object in the frame of the last link.
        to_pregrasp: path from the start to the pre-grasp.
        approach: straight line from the pre-grasp to the grasp.
        lift_off: straight line up, first part of the lift; the object still touches its support.
        lift: straight line up, remaining part of the lift with the attached object.
        planning_seconds: duration of planning ``to_pregrasp`` [s].
    """

    grasp: Grasp
    opening: float
    attached: Array
    to_pregrasp: Segment
    approach: Segment
    lift_off: Segment
    lift: Segment
    planning_seconds: float

    @property
    def clearance(self) -> float:
        """Minimum certified clearance of the plan [m], without the lift-off."""
        return min(segment.path.certificate.clearance for segment in (self.to_pregrasp, self.approach, self.lift))

    @property
    def avoids_moving(self) -> bool:
        """Return whether all segments avoid the regions where motion was observed."""
        return all(s.avoids_moving for s in (self.to_pregrasp, self.approach, self.lift_off, self.lift))


class PickPlanner(Protocol):
    """Plans picks of one target; a method returns the reason as text if it finds no plan."""

    def plan_to(self, grasp: Grasp, start: Array, *, avoid_moving: bool = False) -> PickPlan | str:
        """Plan from ``start`` (J,) to the grasp and the lift.

        If ``avoid_moving`` is set, the plan also avoids the regions where motion was observed.
        """
        ...

    def plan_carry(self, plan: PickPlan, start: Array, goal: JointGoal) -> Segment | str:
        """Plan from the end of ``plan`` to a goal with the attached object."""
        ...


@dataclass(frozen=True, eq=False)
class _Obstacles:
    """Collision fields of a plan.

    Args:
        whole: the whole map.
        around: the map without the target.
        around_held: ``around`` without stray Gaussians inside of the target, which move with it.
    """

    whole: GaussianCollisionField
    around: GaussianCollisionField
    around_held: GaussianCollisionField


class MapPickPlanner:
    """Plans picks against the Gaussians of the sampler's map; every segment is certified.

    Regions where motion was observed during mapping are additional obstacles of plans with ``avoid_moving``. The
    certificates of such plans cover both.

    If the sampler agrees with plans (:meth:`splatbot.grasping.sampler.GraspSampler.agree_with_plans`), the way to the
    pre-grasp avoids the obstacles of plans with the margin of the arm. The links before the hand keep that margin on
    approach and lift too.

    Args:
        sampler: grasp sampler with the map, the robot and its base pose.
        target: the target to pick.
        options: options of the pick.

    Raises:
        InputError: the sampler has regions of motion and agrees with plans, but without a field that includes both.
    """

    def __init__(self, sampler: GraspSampler, target: Target, options: PickOptions) -> None:
        if sampler.departure is not None and sampler.moving is not None and sampler.departure_avoiding is None:
            hint = "give `avoiding` to agree_with_plans, or leave `moving` out"
            raise InputError("has regions of motion and agrees with plans.", field="sampler", hint=hint)
        self.s, self.o = sampler, options
        self._T = sampler.scene.T_world_base
        self._object = target_spheres(sampler, target)
        around = around_target(sampler.scene, target.rows)
        rest = rows_without_strays(around, self._object)
        around_held = around.select(torch.from_numpy(rest))
        rows = rows_around(sampler.scene, target.rows)
        self._surfaces, self._surfaces_held = Surfaces(sampler.scene, rows), Surfaces(sampler.scene, rows[rest])
        field = sampler.collision_field
        whole = sampler.field if sampler.departure is None else sampler.departure
        self._static = _Obstacles(whole, field(around), field(around_held))
        self._avoiding_moving: _Obstacles | None = None
        if sampler.moving is not None:
            if sampler.departure_avoiding is not None:
                whole = sampler.departure_avoiding
            else:
                whole = field(sampler.scene.model, avoid_moving=True)
            without, held = (field(model, avoid_moving=True) for model in (around, around_held))
            self._avoiding_moving = _Obstacles(whole, without, held)

    def plan_to(self, grasp: Grasp, start: Array, *, avoid_moving: bool = False) -> PickPlan | str:
        """Plan a pick; see :class:`PickPlanner`."""
        if grasp.q_pregrasp is None:
            return "no posture is known"
        obstacles, avoids_moving = self._obstacles(avoid_moving)
        opening = min(
            float(np.ceil(grasp.opening / HANDS.opening_step - 1e-6)) * HANDS.opening_step, self.s.hand.stroke
        )
        planner = self._planner(obstacles.whole, opening)
        begin = time.perf_counter()
        plan = planner.plan(start, JointGoal(grasp.q_pregrasp), budget_ms=self.o.budget_ms, seed=self.o.seed)
        planning_seconds = time.perf_counter() - begin
        if plan.path is None:
            return plan.reason.rstrip(".")
        hand = self._arm(opening)
        approach = straight_line(hand, obstacles.around, grasp.q_pregrasp, grasp.T_world_tcp)
        if not approach or approach.path is None:
            return f"its approach is blocked: {self._surfaces.reason(approach)}"
        lift = self._lift(obstacles.around_held, approach.path.waypoints[-1], grasp.width)
        if isinstance(lift, str):
            return lift
        guards, guards_held = self._guards(obstacles.around), self._guards(obstacles.around_held)
        found = PickPlan(
            grasp,
            opening,
            lift.attached,
            to_pregrasp=Segment(plan.path, planner.arm, obstacles.whole, avoids_moving),
            approach=Segment(approach.path, hand, obstacles.around, avoids_moving, guards),
            lift_off=Segment(lift.off, lift.closed, obstacles.around_held, avoids_moving, guards_held),
            lift=Segment(lift.up, lift.loaded, obstacles.around_held, avoids_moving, guards_held),
            planning_seconds=planning_seconds,
        )
        for segment in (found.approach, found.lift_off, found.lift):
            for guard in segment.guards:
                if guard.meets(segment.path.waypoints):
                    return guard.reason
        return found

    def plan_carry(self, plan: PickPlan, start: Array, goal: JointGoal) -> Segment | str:
        """Plan a path with the attached object, if possible around the regions where motion was observed."""
        for avoid_moving in (True, False) if self._avoiding_moving is not None and plan.avoids_moving else (False,):
            obstacles, avoids_moving = self._obstacles(avoid_moving)
            planner = self._planner(obstacles.around_held, plan.grasp.width, plan.attached)
            result = planner.plan(start, goal, budget_ms=self.o.budget_ms, seed=self.o.seed)
            if result.path is not None:
                return Segment(result.path, planner.arm, obstacles.around_held, avoids_moving)
        return result.reason

    def adjusted(self, plan: PickPlan, T_now_before: Array, target: Target, here: Array) -> Adjusted | str:
        """Plan a pick of the target at its new place, from the arm's position near the old pre-grasp.

        The planner of the new place, its plan, and the sampler of the moved map belong together.

        Args:
            plan: the plan to the old place.
            T_now_before: (4, 4) motion of the target in the world [m].
            target: the target.
            here: (J,) joint positions [rad or m].
        """
        sampler = moved_sampler(self.s, target.rows, T_now_before)
        planner = MapPickPlanner(sampler, target, self.o)
        arm = self._arm(plan.opening)
        goal = T_now_before @ plan.grasp.T_world_pregrasp
        way = straight_line(arm, planner._static.whole, here, goal)
        if not way or way.path is None:
            return f"its new pre-grasp is not reached: {way.reason.rstrip('.')}"
        grasp = moved_grasp(plan.grasp, T_now_before, way.path.waypoints[-1])
        found = planner.plan_to(grasp, here)
        return found if isinstance(found, str) else Adjusted(sampler, planner, found)

    def moved(self, grasp: Grasp, T_now_before: Array) -> Grasp | None:
        """Return a grasp of the target after its motion (4, 4) in the world, or None if the arm does not reach it."""
        opening = min(grasp.opening + HANDS.opening_step, self.s.hand.stroke)
        goal = PoseGoal(T_now_before @ grasp.T_world_pregrasp, postures=1)
        near = self.s.robot.home if grasp.q_pregrasp is None else grasp.q_pregrasp
        found = goal_configurations(
            self._arm(opening), self._static.whole, goal, near=near, seed=self.o.seed, until=time.perf_counter()
        )
        return moved_grasp(grasp, T_now_before, found.q[0]) if len(found.q) else None

    def _obstacles(self, avoid_moving: bool) -> tuple[_Obstacles, bool]:
        """Return the obstacles of a plan, and whether they include all regions where motion was observed."""
        if avoid_moving and self._avoiding_moving is not None:
            return self._avoiding_moving, True
        return self._static, self._avoiding_moving is None

    def _planner(
        self, field: GaussianCollisionField, opening: float, attached: ArrayLike | None = None
    ) -> GaussianRRTStar:
        margin = self.s.margin if self.s.departure is None else max(self.s.margin, self.s.arm_margin)
        return GaussianRRTStar(
            field, self.s.robot, T_world_base=self._T, opening=opening, attached=attached, margin=margin
        )

    def _arm(self, opening: float, attached: ArrayLike | None = None) -> RobotSpheres:
        return RobotSpheres(
            self.s.robot, T_world_base=self._T, opening=opening, attached=attached, margin=self.s.margin
        )

    def _guards(self, field: GaussianCollisionField) -> tuple[LinkGuard, ...]:
        if self.s.departure is None:
            return ()
        return link_guards(
            self.s.robot, self._T, field, margin=self.s.margin, arm_margin=self.s.arm_margin, unknown=self.s.unknown
        )

    def _lift(self, around_held: GaussianCollisionField, q: Array, width: float) -> Lift | str:
        return lift_target(
            self.s, self._object, around_held, self._surfaces_held, q, width,
            lift_off=self.o.lift_off, height=self.o.lift,
        )  # fmt: skip


@dataclass(frozen=True, eq=False)
class Adjusted:
    """A plan after the target moved.

    Args:
        sampler: of the map in which it moved.
        planner: of that map.
        plan: to its new place.
    """

    sampler: GraspSampler
    planner: MapPickPlanner
    plan: PickPlan

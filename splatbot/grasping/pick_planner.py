"""The whole way of a pick, to a grasp and up again with the object, certified before anything moves."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.geometry import inverse, transform_points
from splatbot.grasping.affordance import Target
from splatbot.grasping.hands import OPENINGS
from splatbot.grasping.held import covering_spheres
from splatbot.grasping.obstacles import around_target
from splatbot.grasping.pick_types import PickOptions
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.types import Grasp
from splatbot.planning import GaussianRRTStar, JointGoal, Path
from splatbot.planning.cartesian import StraightResult, straight_line
from splatbot.protocols import Array

_N_SIGMA = 1.0  # of a held object's Gaussians
_SIDES = 5  # on which the object must be around a stray within it; the sixth may be open, as a cup's


@dataclass(frozen=True, eq=False)
class Segment:
    """A part of the way.

    Args:
        path: of the arm.
        arm: its spheres, with what it holds.
        around: that it is free of, as far as corners may be rounded; None: that was looked at otherwise.
        clear: whether it keeps clear of where something moved; True also where nothing did.
    """

    path: Path
    arm: RobotSpheres
    around: GaussianCollisionField | None
    clear: bool = True


@dataclass(frozen=True, eq=False)
class PickPlan:
    """To one grasp and up again.

    Args:
        grasp: that it leads to.
        opening: of the fingers on the way there [m].
        attached: (A, 4) spheres of the object in the last link's frame, as planning takes it along.
        there: to the pre-grasp.
        approach: straight to the grasp.
        free: straight up, the first stretch of the lift.
        lift: the rest of it, with the object.
        planned: seconds that the search for ``there`` took.
    """

    grasp: Grasp
    opening: float
    attached: Array
    there: Segment
    approach: Segment
    free: Segment
    lift: Segment
    planned: float

    @property
    def room(self) -> float:
        """All the way [m]."""
        return min(leg.path.certificate.clearance for leg in (self.there, self.approach, self.lift))

    @property
    def clear(self) -> bool:
        """All of it, of where something moved."""
        return all(leg.clear for leg in (self.there, self.approach, self.free, self.lift))


class PickPlanner(Protocol):
    """Finds ways to grasps of one target; words instead of a way say what is in it."""

    def to(self, grasp: Grasp, start: Array, *, cautious: bool = False) -> PickPlan | str:
        """From where the arm is (J,) to the grasp and up again; ``cautious``: clear of where something moved, too."""
        ...

    def onwards(self, way: PickPlan, start: Array, goal: JointGoal) -> Segment | str:
        """From where the way ended, with the object, to another place."""
        ...


@dataclass(frozen=True, eq=False)
class _Obstacles:
    """What a way keeps clear of: the whole map, the map around the target, and that less the target's own strays."""

    whole: GaussianCollisionField
    around: GaussianCollisionField
    beside: GaussianCollisionField


class MapPickPlanner:
    """Among the Gaussians of the sampler's map, every stretch certified.

    Where something moved while the map was made is one more obstacle of cautious ways; their certificates are of both.

    Args:
        sampler: of the grasps; it has the map, the robot and where it stands.
        target: that is to be picked.
        options: how.
    """

    def __init__(self, sampler: GraspSampler, target: Target, options: PickOptions) -> None:
        self.s, self.o = sampler, options
        self._T = sampler.scene.T_world_base
        self._object = target_spheres(sampler, target)
        around = around_target(sampler.scene, target.rows)
        # What is within the target are its own strays, which segmentation has left out.
        inside = within(around.means.detach().double().numpy(), self._object)
        beside = around.select(torch.from_numpy(~inside))
        field = sampler.collision_field
        self._static = _Obstacles(sampler.field, field(around), field(beside))
        self._cautious: _Obstacles | None = None
        if sampler.moving is not None:
            models = (sampler.scene.model, around, beside)
            self._cautious = _Obstacles(*(field(model, cautious=True) for model in models))

    def to(self, grasp: Grasp, start: Array, *, cautious: bool = False) -> PickPlan | str:
        """See :class:`PickPlanner`."""
        if grasp.q_pregrasp is None:
            return "no posture is known"
        obstacles, clear = self._obstacles(cautious)
        opening = min(float(np.ceil(grasp.opening / OPENINGS - 1e-6)) * OPENINGS, self.s.hand.stroke)
        planner = self._planner(obstacles.whole, opening)
        begin = time.perf_counter()
        plan = planner.plan(start, JointGoal(grasp.q_pregrasp), budget_ms=self.o.budget_ms, seed=self.o.seed)
        planned = time.perf_counter() - begin
        if plan.path is None:
            return plan.reason.rstrip(".")
        approach = straight_line(planner.arm, obstacles.around, grasp.q_pregrasp, grasp.T_world_tcp)
        if not approach or approach.path is None:
            return f"its approach is blocked: {approach.reason.rstrip('.')}"
        q = approach.path.waypoints[-1]
        closed = self._arm(grasp.width)
        attached = in_hand(closed, q, self._object)
        loaded = self._arm(grasp.width, attached)
        free = self._up(closed, obstacles.beside, q, self.o.free)
        if not free or free.path is None:
            return f"it cannot be lifted: {free.reason.rstrip('.')}"
        lift = self._up(loaded, obstacles.beside, free.path.waypoints[-1], self.o.lift - self.o.free)
        if not lift or lift.path is None:
            return f"it cannot be lifted: {lift.reason.rstrip('.')}"
        return PickPlan(
            grasp,
            opening,
            attached,
            Segment(plan.path, planner.arm, obstacles.whole, clear),
            Segment(approach.path, planner.arm, obstacles.around, clear),
            Segment(free.path, closed, obstacles.beside, clear),
            Segment(lift.path, loaded, obstacles.beside, clear),
            planned,
        )

    def onwards(self, way: PickPlan, start: Array, goal: JointGoal) -> Segment | str:
        """Around everything, with what is held; where it can be, clear of where something moved, too."""
        for cautious in (True, False) if self._cautious is not None and way.clear else (False,):
            obstacles, clear = self._obstacles(cautious)
            planner = self._planner(obstacles.beside, way.grasp.width, way.attached)
            plan = planner.plan(start, goal, budget_ms=self.o.budget_ms, seed=self.o.seed)
            if plan.path is not None:
                return Segment(plan.path, planner.arm, obstacles.beside, clear)
        return plan.reason

    def _obstacles(self, cautious: bool) -> tuple[_Obstacles, bool]:
        """Of a way, and whether all that moved is among them."""
        if cautious and self._cautious is not None:
            return self._cautious, True
        return self._static, self._cautious is None

    def _planner(
        self, field: GaussianCollisionField, opening: float, attached: ArrayLike | None = None
    ) -> GaussianRRTStar:
        return GaussianRRTStar(
            field, self.s.robot, T_world_base=self._T, opening=opening, attached=attached, margin=self.s.margin
        )

    def _arm(self, opening: float, attached: ArrayLike | None = None) -> RobotSpheres:
        return RobotSpheres(
            self.s.robot, T_world_base=self._T, opening=opening, attached=attached, margin=self.s.margin
        )

    def _up(self, arm: RobotSpheres, beside: GaussianCollisionField, q: Array, by: float) -> StraightResult:
        return straight_line(arm, beside, q, raised(self.s, arm, q, by))


def target_spheres(sampler: GraspSampler, target: Target) -> Array:
    """A target as spheres (A, 4) [m, world] that cover its surface, what was not seen of it included."""
    surface = sampler.surface(target)
    return covering_spheres(surface.points, np.where(surface.seen, 0.0, surface.spread) + _N_SIGMA * surface.doubt)


def within(points: Array, spheres: Array) -> NDArray[np.bool_]:
    """Which points (P, 3) are in spheres (A, 4), or have some of them on five of six sides: an object's own strays."""
    low, high = (spheres[:, :3] - spheres[:, 3:]).min(axis=0), (spheres[:, :3] + spheres[:, 3:]).max(axis=0)
    found = np.zeros(len(points), np.bool_)
    rows = np.flatnonzero(((points >= low) & (points <= high)).all(axis=1))
    between = spheres[None, :, :3] - points[rows, None]
    sides = np.zeros(len(rows), np.int64)
    for k in range(3):
        beside = np.linalg.norm(np.delete(between, k, axis=2), axis=2) < spheres[:, 3]
        sides += (beside & (between[..., k] > 0)).any(axis=1)
        sides += (beside & (between[..., k] < 0)).any(axis=1)
    found[rows] = (sides >= _SIDES) | (np.linalg.norm(between, axis=2) <= spheres[:, 3]).any(axis=1)
    return found


def in_hand(arm: RobotSpheres, q: Array, spheres: Array) -> Array:
    """Spheres (A, 4) of the world in the frame of the last link, the arm being at ``q`` (J,)."""
    T_link_world = inverse(arm.forward(q[None])[0, -1])
    return np.c_[transform_points(T_link_world, spheres[:, :3]), spheres[:, 3]]


def raised(sampler: GraspSampler, arm: RobotSpheres, q: Array, by: float) -> Array:
    """The tool's pose (4, 4) at ``q`` (J,), higher by so much [m]."""
    tool = np.asarray(sampler.robot.T_link_tcp, dtype=np.float64)  # type: ignore[attr-defined]
    T = np.asarray(arm.forward(q[None])[0, -1] @ tool)
    T[:3, 3] += by * sampler.scene.up
    return T

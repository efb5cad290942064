"""Common interface of the stacks of a trial: from a scan to grasps and paths to them."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Protocol

import numpy as np
import torch

from splatbot.collision import GaussianCollisionField, RobotSpheres, find_moving, gather_evidence
from splatbot.collision.moving import with_balls
from splatbot.config import SensorConfig
from splatbot.gaussians import GaussianModel
from splatbot.grasping.affordance import AffordanceError, Hint, Target, find_target
from splatbot.grasping.measured import RawDepth
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.pick_planner import MapPickPlanner, PickPlan, PickPlanner, Segment
from splatbot.grasping.pick_types import PickOptions
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.spatial import SpatialAffordance
from splatbot.grasping.types import Grasp, GraspResult
from splatbot.planning import JointGoal
from splatbot.protocols import Array
from splatbot.results.plan_obstacles import PlanObstacles
from splatbot.robots.panda import panda
from splatbot.segmentation import SegmentedMap, segment
from splatbot.sim.trials.scan import TrialScan
from splatbot.sim.trials.scenes import TrialScene


@dataclass(frozen=True)
class StackConstants:
    """Constants of the stack under trial.

    Args:
        lift: [m] lift of a pick; success requires 0.15 m.
        budget_ms: [ms] budget of the path search.
        min_observations: keyframes that must support a Gaussian.
        margin: [m] clearance of the arm on its way to the pre-grasp.
    """

    lift: float = 0.18
    budget_ms: float = 28.0
    min_observations: int = 3
    margin: float = 0.005


CONSTANTS = StackConstants()


# [m] corners of segmentation from the base, below the board of a shelf.
_WORKSPACE = np.array([[-2.0, -2.0, -0.2], [2.0, 2.0, 0.35]])
SENSOR = SensorConfig()  # noise of depth that confirms a point
OPTIONS = PickOptions(lift=CONSTANTS.lift, budget_ms=CONSTANTS.budget_ms, tries=8, grasp=GraspOptions())


@dataclass(frozen=True, eq=False)
class StackMap:
    """A stack's representation of a scan.

    Args:
        scene: its segmented surface.
        planners: returns the grasp sampler and the pick planner for a target.
        world_bytes: size of the map and its collision field [bytes].
        seconds: build time [s].
    """

    scene: SegmentedMap
    planners: Callable[[Target], tuple[GraspSampler, PickPlanner]]
    world_bytes: int
    seconds: float


class Stack(Protocol):
    """A perception and planning stack."""

    @property
    def name(self) -> str:
        """Name in tables."""
        ...

    @property
    def looks(self) -> bool:
        """Return whether the arm looks again from the wrist before the fingers close."""
        ...

    def learn(self, scan: TrialScan) -> StackMap:
        """Build a map from a scan."""
        ...


class GaussianStack:
    """The Gaussians of the map, with certified paths.

    The way to the pre-grasp has the obstacles of ``splatbot plan``: the map at 2 sigma, its support plane, and places
    of motion where that is possible. Unknown space is free: of space near the camera's path few views decide, and the
    holes of the simulated depth would close it.
    """

    name = "gaussians"
    looks = False

    def learn(self, scan: TrialScan) -> StackMap:
        """Implement :meth:`Stack.learn`."""
        begin = time.perf_counter()
        sampler = self.sampler(scan)
        if not self.looks:  # the obstacles of plans do not follow a target that moved
            _agree_with_plans(sampler)
        seconds = scan.seconds + time.perf_counter() - begin
        world = sampler.scene.model.nbytes + sampler.field.nbytes
        return StackMap(
            sampler.scene, lambda target: (sampler, MapPickPlanner(sampler, target, OPTIONS)), world, seconds
        )

    def sampler(self, scan: TrialScan, *, hand_only: bool = False) -> GraspSampler:
        """Return the grasp sampler on the map of a scan, for the hand alone or with the arm."""
        # Removes flying pixels at edges and traces of moving objects, which more frames contradict than support.
        evidence = gather_evidence(scan.snapshot.model, scan.views)
        solid = np.flatnonzero(~evidence.seen_through)
        moving = find_moving(scan.snapshot.model, evidence)
        return GraspSampler(
            segment(scan.snapshot.model.select(torch.from_numpy(solid)), scan.T_world_base, box=_WORKSPACE, cut=False),
            panda(),
            hand_only=hand_only,
            observers=scan.observers[solid],
            views=scan.views,
            raw=RawDepth(tuple(scan.views), SENSOR.sigma_depth_floor, SENSOR.sigma_depth_quad),
            min_observations=CONSTANTS.min_observations,
            arm_margin=CONSTANTS.margin,
            moving=moving,
        )


def _agree_with_plans(sampler: GraspSampler) -> None:
    """Give a sampler the obstacles of plans from the home configuration of its robot."""
    T, support = sampler.scene.T_world_base, sampler.scene.support
    arm = RobotSpheres(panda(), T_world_base=T)
    plane = None
    if support is not None:
        normal = T[:3, :3] @ support.normal
        plane = np.append(normal, -support.offset - normal @ T[:3, 3])

    def with_plane(model: GaussianModel) -> GaussianCollisionField:
        obstacles = PlanObstacles(GaussianCollisionField(model), model, arm, panda().home, plane=plane)
        return obstacles.field(CONSTANTS.margin)

    model, avoiding = sampler.scene.model, None
    field = with_plane(model)
    if sampler.moving is not None:
        avoiding = with_plane(with_balls(model, sampler.moving, n_sigma=field.n_sigma, observations=1))
    sampler.agree_with_plans(field, avoiding=avoiding)


class LookingStack(GaussianStack):
    """The same without the obstacles of plans, with a look from the wrist before the fingers close, and retries."""

    name = "gaussians_look"
    looks = True


@dataclass(frozen=True, eq=False)
class StackDecision:
    """A target, its grasps, and the paths to them.

    Args:
        target: as found.
        sampler: of its grasps.
        grasps: of it.
        planner: of paths to the grasps, each planned once.
        seconds: until the ranked list of grasps [s].
        looks: whether the arm looks again; it then plans with the map alone.
    """

    target: Target
    sampler: GraspSampler
    grasps: GraspResult
    planner: PickPlanner
    seconds: float
    looks: bool = False


def decide(known: StackMap, hint: Hint, *, looks: bool = False) -> StackDecision:
    """Find the object that a hint marks, and grasps of it.

    Raises:
        AffordanceError: there is no object.
    """
    target = find_target(hint, known.scene, [SpatialAffordance()])
    sampler, planner = known.planners(target)
    begin = time.perf_counter()
    grasps = sampler.sample(target, OPTIONS.grasp)
    return StackDecision(target, sampler, grasps, _CachedPlanner(planner), time.perf_counter() - begin, looks)


def choose(
    known: StackMap, trial: TrialScene, scan: TrialScan, *, looks: bool = False
) -> tuple[TrialScene, StackDecision]:
    """Return the trial with the candidate that has the best grasp, and its grasps.

    Grasps with a certified lift are better than all others. In a pile, an object under others has grasps without one.

    Raises:
        AffordanceError: there is no object at any hint.
    """
    found: list[tuple[str, StackDecision]] = []
    refused: AffordanceError | None = None
    for name, hint in scan.hints.items():
        try:
            found.append((name, decide(known, hint, looks=looks)))
        except AffordanceError as error:
            refused = error
    if not found:
        assert refused is not None
        raise refused
    name, best = max(found, key=lambda one: max(map(_rank, one[1].grasps.grasps), default=(False, -1.0)))
    seconds = sum(decision.seconds for _, decision in found)
    kinds = {trial.target: trial.kind, **trial.others}
    return replace(trial, target=name, kind=kinds[name]), replace(best, seconds=seconds)


def _rank(grasp: Grasp) -> tuple[bool, float]:
    """Return whether a grasp can be lifted as far as is known, and its confidence 0..1."""
    return not grasp.lift_blocked, grasp.confidence


class _CachedPlanner:
    """Plans each path once, so that two twins follow the same path."""

    def __init__(self, planner: PickPlanner) -> None:
        self._planner = planner
        self._found: dict[tuple[int, bool], PickPlan | str] = {}

    def plan_to(self, grasp: Grasp, start: Array, *, avoid_moving: bool = False) -> PickPlan | str:
        """Return the plan of the first call for a grasp."""
        key = id(grasp), avoid_moving
        if key not in self._found:
            self._found[key] = self._planner.plan_to(grasp, start, avoid_moving=avoid_moving)
        return self._found[key]

    def plan_carry(self, plan: PickPlan, start: Array, goal: JointGoal) -> Segment | str:
        """Plan the motion after a pick without caching."""
        return self._planner.plan_carry(plan, start, goal)

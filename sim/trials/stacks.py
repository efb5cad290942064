"""What the stacks of a trial have in common: the scan goes in, grasps and ways to them come out."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol

import numpy as np
import torch

from splatbot.collision import find_moving, gather_evidence
from splatbot.grasping.affordance import Target, find_target
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.pick_planner import MapPickPlanner, PickPlan, PickPlanner, Segment
from splatbot.grasping.pick_types import PickOptions
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.spatial import SpatialAffordance
from splatbot.grasping.types import Grasp, GraspResult
from splatbot.planning import JointGoal
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.segmentation import SegmentedMap, segment
from splatbot.sim.trials.look import Look

LIFT = 0.18  # [m]; 15 cm are asked for
BUDGET_MS = 28.0  # of the search for a way
_OFTEN = 3  # keyframes that must support what is no air
OPTIONS = PickOptions(lift=LIFT, budget_ms=BUDGET_MS, tries=8, grasp=GraspOptions())


@dataclass(frozen=True, eq=False)
class Knowledge:
    """What a stack made of a scan.

    Args:
        scene: its surface, segmented.
        towards: for a target, who samples its grasps and who finds ways to them.
        world_bytes: of what it plans in.
        seconds: that building it took.
    """

    scene: SegmentedMap
    towards: Callable[[Target], tuple[GraspSampler, PickPlanner]]
    world_bytes: int
    seconds: float


class Stack(Protocol):
    """A way to represent what was seen."""

    @property
    def name(self) -> str:
        """As tables have it."""
        ...

    def learn(self, look: Look) -> Knowledge:
        """Make a world of a scan."""
        ...


class GaussianStack:
    """The Gaussians of the map, certified all along."""

    name = "gaussians"

    def learn(self, look: Look) -> Knowledge:
        """See :class:`Stack`."""
        begin = time.perf_counter()
        # Flying pixels at edges and ghosts of what moved: more frames saw through them than saw them.
        evidence = gather_evidence(look.snapshot.model, look.views)
        solid = np.flatnonzero(~evidence.seen_through)
        moving = find_moving(look.snapshot.model, evidence)
        model = look.snapshot.model.select(torch.from_numpy(solid))
        scene = segment(model, look.T_world_base, cut=False)
        observers = look.observers[solid]
        sampler = GraspSampler(
            scene, panda(), observers=observers, views=look.views, min_observations=_OFTEN, moving=moving
        )
        seconds = look.seconds + time.perf_counter() - begin
        world = model.nbytes + sampler.field.nbytes
        return Knowledge(scene, lambda target: (sampler, MapPickPlanner(sampler, target, OPTIONS)), world, seconds)


@dataclass(frozen=True, eq=False)
class StackDecision:
    """A target, grasps of it, and the way to one.

    Args:
        target: as it was found.
        sampler: of its grasps.
        grasps: of it.
        ways: to them, each looked for once.
        seconds: to the ranked list.
    """

    target: Target
    sampler: GraspSampler
    grasps: GraspResult
    ways: PickPlanner
    seconds: float


def decide(known: Knowledge, look: Look) -> StackDecision:
    """Find what was clicked at, and grasps of it.

    Raises:
        AffordanceError: there is nothing.
    """
    target = find_target(look.hint, known.scene, [SpatialAffordance()])
    sampler, ways = known.towards(target)
    begin = time.perf_counter()
    grasps = sampler.sample(target, OPTIONS.grasp)
    return StackDecision(target, sampler, grasps, _Remembered(ways), time.perf_counter() - begin)


class _Remembered:
    """Ways that are found once, so that two twins follow the same."""

    def __init__(self, ways: PickPlanner) -> None:
        self._ways = ways
        self._found: dict[tuple[int, bool], PickPlan | str] = {}

    def plan_to(self, grasp: Grasp, start: Array, *, avoid_moving: bool = False) -> PickPlan | str:
        """As when it was first asked."""
        key = id(grasp), avoid_moving
        if key not in self._found:
            self._found[key] = self._ways.plan_to(grasp, start, avoid_moving=avoid_moving)
        return self._found[key]

    def plan_carry(self, plan: PickPlan, start: Array, goal: JointGoal) -> Segment | str:
        """Asked anew."""
        return self._ways.plan_carry(plan, start, goal)

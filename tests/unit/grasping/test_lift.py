"""The lift of a target, blocked approaches, and the words for them."""

from __future__ import annotations

import re
from dataclasses import replace

import numpy as np
import pytest

from splatbot.bench.tabletop import Block
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.gaussians import GaussianModel
from splatbot.grasping.advice import first_change
from splatbot.grasping.affordance import Target
from splatbot.grasping.doubts import part_note
from splatbot.grasping.lift import target_spheres
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.reach import BLOCKED, BLOCKED_FAR, BLOCKED_NEAR, ArmReach
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.types import FITTING, GraspResult
from splatbot.planning.causes import collision
from splatbot.protocols import Array
from splatbot.report.sphere_gaussians import sphere_gaussians
from splatbot.robots.panda import panda
from splatbot.segmentation import SegmentedMap, segment
from tests.unit.grasping.objects import BOX, colored, scene, target_of


def ball(at: Array, radius: float) -> GaussianModel:
    return sphere_gaussians(at[None], np.array([radius]), np.array([0.5, 0.5, 0.5]), 0.99)


def with_touching_ball(at: Array) -> SegmentedMap:
    """Return the table with a fixed ball of 8 mm at a place, which no object owns."""
    model = GaussianModel.concatenate([scene().model, ball(at, 0.008)])
    return replace(scene(), model=model, labels=np.r_[scene().labels, np.int32(-1)].astype(np.int32))


def test_grasps_that_plans_cannot_lift_state_why_and_name_the_held_object() -> None:
    """A ball at the end of the long side of the box reaches 6 mm into the spheres that cover the box."""
    long_side = np.array([np.cos(0.4), np.sin(0.4), 0.0])
    few, target = GraspOptions(samples=100), target_of(scene(), BOX, "box")
    spheres = target_spheres(GraspSampler(scene(), panda()), target)
    out = np.array([0.45, 0.10, 0.09]) + np.linspace(0.05, 0.09, 81)[:, None] * long_side
    gap = (np.linalg.norm(out[:, None] - spheres[None, :, :3], axis=2) - spheres[:, 3]).min(axis=1)
    at = out[np.argmax(gap > 0.002)]
    touched = with_touching_ball(at)
    sampler = GraspSampler(touched, panda())
    before = sampler.sample(target, few).grasps
    assert not any(grasp.lift_blocked for grasp in before)
    sampler.agree_with_plans(GaussianCollisionField(GaussianModel.empty(0), 2.0))
    result = sampler.sample(target, few)
    assert len(result.grasps) == len(before)
    assert all(grasp.lift_blocked for grasp in result.grasps)
    reason = result.grasps[0].lift_blocked
    assert f"{len(before)} of {len(before)} grasps have no certified lift" in " ".join(result.notes)
    assert reason.startswith("it cannot be lifted: 30 mm up, at the start the held object is")
    assert "deep in Gaussians without a label at" in reason
    place = np.array([float(x) for x in re.findall(r"-?\d\.\d\d(?=[,)])", reason)])
    assert np.linalg.norm(place - at) < 0.05


def test_a_contact_of_the_attached_object_is_not_that_of_the_last_link() -> None:
    arm, q = panda(), np.asarray(panda().home)
    loaded = RobotSpheres(arm, attached=[[0.0, 0.0, 0.3, 0.02]])
    at = loaded.centers(q[None])[0][-1]
    held = str(collision(loaded, GaussianCollisionField(ball(at, 0.005)), q))
    assert held.startswith("the held object is 2")  # 20 mm of its sphere and 5 mm of the ball
    wrist = loaded.centers(q[None])[0][np.flatnonzero(loaded.spheres.link == 7)[0]]
    assert str(collision(loaded, GaussianCollisionField(ball(wrist, 0.005)), q)).startswith("link 7 (after ")


@pytest.mark.parametrize(("low", "high", "kind"), [(0.0, 0.04, BLOCKED_NEAR), (0.06, 0.10, BLOCKED_FAR)])
def test_a_shorter_approach_is_advised_only_where_the_obstacle_is_beyond_it(low: float, high: float, kind: str) -> None:
    """A ball of 1 mm lies where a sphere of the hand enters between two distances on the way back."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = (0.5, 0.0, 0.3)
    above = T.copy()
    above[2, 3] += 0.1
    free = ArmReach(panda(), np.eye(4), GaussianCollisionField(GaussianModel.empty(0)))
    found = free.reach(T, above, 0.08, 0.06)
    assert found.path is not None
    arm, way = free.arm(0.08), found.path[::-1]
    back = np.linspace(0.0, 0.1, len(way))
    centers, radii = arm.centers(way), arm.spheres.radii
    before, then = np.flatnonzero(back <= low), np.flatnonzero((back > low) & (back <= high))
    tops = centers[then[-1]] + radii[:, None] * [0.0, 0.0, 0.98]
    gap = np.linalg.norm(tops[None, :, None] - centers[before][:, None], axis=3) - radii
    of_hand = arm.spheres.link == 7  # it moves alike in all postures
    best = int(np.argmax(np.where(of_hand, gap.min(axis=(0, 2)), -np.inf)))
    assert gap[:, best].min() > 0.003
    blocked = ArmReach(panda(), np.eye(4), GaussianCollisionField(ball(tops[best], 0.001))).reach(T, above, 0.08, 0.06)
    assert blocked.q is None
    assert blocked.kind == kind
    target = target_of(scene(), BOX, "box")
    some = GraspSampler(scene(), panda(), hand_only=True).sample(target, GraspOptions(samples=50))
    shown = replace(some.grasps[0], rejected=blocked.reason)
    reason, change = first_change(
        replace(some, grasps=(), doubtful=(), rejected={FITTING + kind: 3}, best_rejected=shown), scene(), 0.08
    )
    assert reason == blocked.reason
    assert reason.startswith(BLOCKED)
    assert ("--pregrasp 0.05" in change) == (kind == BLOCKED_FAR)


def test_a_hand_that_closes_on_one_of_two_touching_boxes_is_noted() -> None:
    """A box of 6 cm touches one of 14 cm, as one cluster: the hand takes the narrow one."""
    narrow, wide = Block((0.45, 0.10, 0.05), (0.06, 0.06, 0.10)), Block((0.45, 0.20, 0.05), (0.14, 0.14, 0.10))
    both = segment(colored({"narrow": narrow, "wide": wide}, 10_000, {}), np.eye(4))
    cluster = max(both.objects, key=lambda item: len(item.rows))
    assert cluster.size[0] > 0.19
    sampler, few = GraspSampler(both, panda(), hand_only=True), GraspOptions(samples=100, wanted=3)
    result = sampler.sample(Target(cluster.rows, None, "both", "place", 1.0, (), cluster.number), few)
    noted = [note for note in result.notes if "closes on a part of the target" in note]
    assert len(noted) == 1
    assert "--mask" in noted[0]
    first = result.grasps[0]
    along = (first.contacts[1] - first.contacts[0]) / np.linalg.norm(first.contacts[1] - first.contacts[0])
    corners = np.array([[x, y, z] for x in (0.38, 0.52) for y in (0.13, 0.27) for z in (0.0, 0.10)])
    farthest = np.abs((corners - first.contacts.mean(axis=0)) @ along).max() - first.width / 2
    assert abs(float(re.findall(r"up to (\d+) mm", noted[0])[0]) - 1e3 * farthest) < 8.0
    alone = GraspSampler(scene(), panda(), hand_only=True).sample(target_of(scene(), BOX, "box"), few)
    assert alone.grasps
    assert not any("closes on a part" in note for note in alone.notes)


def test_the_size_of_the_whole_cluster_is_no_reason_against_a_marked_part_of_it() -> None:
    number, whole = next((o.number, o.rows) for o in scene().objects if o.size[1] > 0.1)
    part = Target(whole[: len(whole) // 3], None, "part", "place", 1.0, (), number)
    result = GraspResult(part, (), {FITTING + BLOCKED_FAR: 2}, None, 2, {}, map_version=0)
    assert first_change(result, scene(), 0.08)[0] == BLOCKED
    assert "apart" in first_change(replace(result, target=replace(part, rows=whole)), scene(), 0.08)[0]


@pytest.mark.parametrize("degrees", [0.0, 10.0, 20.0])
def test_a_closing_direction_that_is_tilted_on_a_tall_object_alone_is_not_noted(degrees: float) -> None:
    rng = np.random.default_rng(0)
    points = rng.uniform(-0.5, 0.5, (4000, 3)) * (0.06, 0.06, 0.20)
    rise = 0.03 * np.tan(np.radians(degrees))
    some = GraspSampler(scene(), panda(), hand_only=True).sample(
        target_of(scene(), BOX, "box"), GraspOptions(samples=50)
    )
    contacts = np.array([[-0.03, 0.0, -rise], [0.03, 0.0, rise]])
    normals = np.array([[-1.0, 0.0, 0.0], [1.0, 0.0, 0.0]])
    tilted = replace(some.grasps[0], contacts=contacts, normals=normals)
    assert part_note(tilted, points) == ""
    assert "100%" in part_note(tilted, points + np.array([0.2, 0.0, 0.0]))
    assert part_note(replace(tilted, normals=normals * 0.0), points) == ""

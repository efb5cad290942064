"""Ranked grasps: hand poses, contacts, reachability by the arm, and the reasons of rejected grasps."""

from __future__ import annotations

import itertools
from functools import cache

import numpy as np
import pytest
import torch

from splatbot.bench.collision.peers import solid_mesh
from splatbot.bench.tabletop import Block, Solid, Tabletop
from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.collision.visibility import DepthView
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, look_at, rotation_to_quat, transform_points
from splatbot.grasping.affordance import Target
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.reach import ArmReach, Reached
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.score import WEIGHTS
from splatbot.grasping.shape_completion import target_surface
from splatbot.grasping.surface import GraspSurface, measured_surface
from splatbot.grasping.types import GraspResult, NoGraspError
from splatbot.logs.raycast import RaycastScene, RaycastSurface
from splatbot.logs.textures import Texture
from splatbot.protocols import Array
from splatbot.report.sphere_gaussians import sphere_gaussians
from splatbot.robots.hands import panda_2f85, panda_2f140
from splatbot.robots.panda import panda
from splatbot.segmentation import SegmentedMap, segment
from tests.unit.grasping.objects import (
    BALL,
    BIG,
    BOX,
    CAN,
    OBJECTS,
    TABLE,
    colored,
    model,
    scene,
    seen_from_above,
    target_of,
)

COVER = 0.005  # [m] that the spheres of a hand reach beyond it


@cache
def sampler() -> GraspSampler:
    return GraspSampler(scene(), panda())


@cache
def grasped(name: str) -> GraspResult:
    return sampler().sample(target_of(scene(), OBJECTS[name], name))


@pytest.mark.parametrize("name", ["box", "can", "ball"])
def test_objects_are_grasped_within_reach_and_ranked(name: str) -> None:
    result = grasped(name)
    assert len(result.grasps) >= 3
    totals = [g.total for g in result.grasps]
    assert totals == sorted(totals, reverse=True)
    for g in result.grasps:
        assert set(g.terms) == set(WEIGHTS) - {"near", "clear", "measured"}
        assert g.avoids_moving
        assert all(0.0 <= value <= 1.0 for value in g.terms.values())
        assert g.width <= g.opening <= 0.08
        assert np.abs(OBJECTS[name].distance(g.contacts)).max() < 3e-3
        assert not g.rejected


@pytest.mark.parametrize("name", ["box", "can"])
def test_the_arm_is_at_the_grasp_and_its_straight_approach_is_collision_free(name: str) -> None:
    others = Tabletop((TABLE, *(s for key, s in OBJECTS.items() if key != name)))
    for g in grasped(name).grasps[:4]:
        assert g.q is not None
        assert g.q_pregrasp is not None
        assert g.approach_path is not None
        np.testing.assert_allclose(panda().tcp(g.q), g.T_world_tcp, atol=1e-5)
        np.testing.assert_allclose(panda().tcp(g.q_pregrasp), g.T_world_pregrasp, atol=2e-3)
        arm = RobotSpheres(panda(), opening=g.opening)
        between = np.concatenate(
            [np.linspace(a, b, 5) for a, b in zip(g.approach_path, g.approach_path[1:], strict=False)]
        )
        moving = arm.spheres.link > 0
        centers = arm.centers(between)[:, moving]
        clearance = others.distance(centers.reshape(-1, 3)).reshape(centers.shape[:2]) - arm.spheres.radii[moving]
        assert clearance.min() > -1e-3


@pytest.mark.parametrize("name", ["box", "can", "ball"])
def test_fingers_and_palm_are_outside_of_the_true_object(name: str) -> None:
    hand = panda().hand
    assert hand is not None
    for g in grasped(name).grasps:
        x, z = np.meshgrid(np.linspace(-0.5, 0.5, 7) * hand.width, np.linspace(-hand.palm, hand.tip, 9))
        for sign in (-1.0, 1.0):
            pad = np.stack([x.ravel(), np.full(x.size, sign * g.opening / 2), z.ravel()], axis=1)
            assert OBJECTS[name].distance(transform_points(g.T_world_tcp, pad)).min() > 0.0
        palm = np.c_[0, 0, -hand.palm]
        assert OBJECTS[name].distance(transform_points(g.T_world_tcp, palm)).min() > 0.0


def test_top_and_side_approaches_follow_the_option() -> None:
    target = target_of(scene(), CAN, "can")
    top = sampler().sample(target, GraspOptions(approach="top")).grasps
    side = sampler().sample(target, GraspOptions(approach="side")).grasps
    assert {g.approach for g in top} == {"top"}
    assert {g.approach for g in side} <= {"side", "front"}
    assert top
    assert side


def test_a_too_large_object_is_refused_with_its_width() -> None:
    result = grasped("big")
    assert not result
    with pytest.raises(NoGraspError, match=r"farther apart than the hand opens.*120 mm apart.*opens 80 mm"):
        result.unwrap()


def test_a_wider_hand_takes_it() -> None:
    found = GraspSampler(scene(), panda_2f140()).sample(target_of(scene(), BIG, "big"))
    assert found.unwrap().width == pytest.approx(BIG.size[0], abs=3e-3)


def test_grasps_that_avoid_moving_regions_come_first_and_a_note_reports_the_others() -> None:
    target = target_of(scene(), BOX, "box")
    side = BOX.center + np.array([-np.sin(BOX.yaw), np.cos(BOX.yaw), 0.0]) * 0.11  # next to its wide face
    moving = np.array([[*side, 0.06], [*side[:2], side[2] + 0.1, 0.06]])
    wary = GraspSampler(scene(), panda(), moving=moving)
    result = wary.sample(target, GraspOptions(wanted=30))
    groups = [[g for g in result.grasps if g.avoids_moving is clear] for clear in (True, False)]
    assert all(groups)
    assert f"{len(groups[0])} of {len(result.grasps)} grasps avoid its region" in " ".join(result.notes)
    for g in result.grasps:
        assert g.terms["clear"] == float(g.avoids_moving)
        assert g.approach_path is not None
        arm = RobotSpheres(panda(), opening=g.opening)
        between = np.concatenate(
            [np.linspace(a, b, 5) for a, b in zip(g.approach_path, g.approach_path[1:], strict=False)]
        )
        clearance = np.linalg.norm(arm.centers(between)[:, :, None] - moving[:, :3], axis=-1) - moving[:, 3]
        assert (clearance - arm.spheres.radii[:, None]).min() > 0.0 or not g.avoids_moving
    order = [(not g.avoids_moving, -g.total) for g in result.grasps]
    assert order == sorted(order)
    assert not any("clear" in g.terms for g in grasped("box").grasps)
    alone = GraspSampler(scene(), panda(), moving=moving, hand_only=True).sample(target).grasps
    assert all(g.avoids_moving == bool(g.terms["clear"]) for g in alone)


class _Nowhere:
    def reach(self, T_world_tcp: Array, T_world_pregrasp: Array, opening: float, width: float) -> Reached:
        return Reached(None, None, 0.0, 0.0, "it is too far", "are too far")


def test_without_a_reachable_grasp_the_best_is_reported_with_its_reason_and_all_are_counted() -> None:
    sampler = GraspSampler(scene(), panda(), make_reach=lambda around, around_held, whole: _Nowhere())
    result = sampler.sample(target_of(scene(), BOX, "box"))
    assert not result.grasps
    assert result.best_rejected is not None
    assert result.best_rejected.rejected == "it is too far"
    assert result.rejected["hands: are too far"] > 0
    with pytest.raises(NoGraspError, match="it is too far"):
        result.unwrap()


def test_a_search_without_result_is_repeated_with_four_times_the_samples_and_a_note() -> None:
    target = target_of(scene(), CAN, "can")
    found = [sampler().sample(target, GraspOptions(samples=2, seed=seed)) for seed in range(6)]
    assert all(result.grasps for result in found)
    retried = "No grasp was found with 2 samples; 8 samples with sharper edges were searched."
    assert 2 <= sum(retried in result.notes for result in found) < 6
    assert not any("were searched" in note for note in grasped("can").notes)


def test_a_too_large_object_is_not_searched_again() -> None:
    assert not grasped("big")
    assert not any("were searched" in note for note in grasped("big").notes)


class _Sharp(GraspSampler):
    """One whose first look is at sharp rims, as the second of any other."""

    def surface(self, target: Target, *, seed: int = 0, sharp: bool = True) -> GraspSurface:
        return super().surface(target, seed=seed, sharp=True)


def test_candidates_of_both_searches_are_counted() -> None:
    box = target_of(scene(), BOX, "box")
    once = GraspSampler(scene(), panda(), hand_only=True).sample(box, GraspOptions(samples=100))
    more = _Sharp(scene(), panda(), hand_only=True).sample(box, GraspOptions(samples=400))
    twice = GraspSampler(scene(), panda(), make_reach=lambda around, around_held, whole: _Nowhere()).sample(
        box, GraspOptions(samples=100)
    )
    assert not twice
    assert twice.candidates == once.candidates + more.candidates
    touch = "hands touch the surroundings of the target"
    assert min(once.rejected[touch], more.rejected[touch]) > 0
    for reason, count in more.rejected.items():
        assert twice.rejected[reason] == once.rejected.get(reason, 0) + count
    assert set(twice.rejected) >= set(once.rejected)


def test_the_links_before_the_hand_keep_the_margin_of_the_arm_while_the_hand_comes_close() -> None:
    target, margin = target_of(scene(), BOX, "box"), 0.04
    few = GraspOptions(samples=100)
    result = GraspSampler(scene(), panda(), arm_margin=margin).sample(target, few)
    assert result.grasps
    assert min(g.clearance for g in result.grasps) <= 0.03  # of the hand, which is nearer
    rows = np.delete(np.arange(len(scene().model)), target.rows)
    around = GaussianCollisionField(scene().model.select(torch.from_numpy(rows)), 1.0)
    spheres = panda().spheres()
    links = spheres.link < 7
    for g in result.grasps:
        assert g.approach_path is not None
        way = np.concatenate([np.linspace(a, b, 20) for a, b in itertools.pairwise(g.approach_path)])
        for T in panda().fk(way):
            T = scene().T_world_base @ T
            placed = T[spheres.link[links]]
            at = np.einsum("sij,sj->si", placed[:, :3, :3], spheres.centers[links]) + placed[:, :3, 3]
            high = spheres.link[links] > 0  # the base stands on the table
            gap = around.clearance(at[high], cut=0.5).distance - spheres.radii[links][high]
            assert gap.min() > margin - 1e-6
    none = GraspSampler(scene(), panda(), arm_margin=0.4).sample(target, few)
    assert not none.grasps
    assert none.rejected["hands: bring the arm within the margin of the map"] > 0
    with pytest.raises(InputError, match="arm_margin"):
        ArmReach(panda(), np.eye(4), around, arm_margin=-1.0)


def test_a_pregrasp_is_where_a_plan_may_end_and_the_arm_stays_out_of_unknown_space() -> None:
    target, few, margin = target_of(scene(), BOX, "box"), GraspOptions(samples=100), 0.01
    first = GraspSampler(scene(), panda()).sample(target, few).grasps[0]
    center, radius = first.T_world_pregrasp[:3, 3] - 0.05 * first.T_world_pregrasp[:3, 2], 0.04
    ball = GaussianModel.from_activated(
        means=center[None],
        quats=[[1, 0, 0, 0]],
        scales=np.full((1, 3), radius / 2),
        opacities=[0.9],
        colors=[[0, 0, 0]],
    )
    sampler = GraspSampler(scene(), panda(), arm_margin=margin)
    plans = GaussianCollisionField(scene().model, 2.0)
    both = GaussianCollisionField(GaussianModel.concatenate([scene().model, ball]), 2.0)
    sampler.agree_with_plans(both, GaussianCollisionField(ball, 2.0))
    result = sampler.sample(target, few)
    assert result.grasps
    assert result.rejected["hands: bring the arm into unknown space"] > 0
    open_, links = panda().spheres(), panda().spheres().link < 7
    for g in result.grasps:
        assert g.approach_path is not None
        for k, q in enumerate(g.approach_path):
            placed = (scene().T_world_base @ panda().fk(q[None])[0])[open_.link]
            at = np.einsum("sij,sj->si", placed[:, :3, :3], open_.centers) + placed[:, :3, 3]
            gap = np.linalg.norm(at - center, axis=1) - open_.radii - radius
            assert gap[links].min() > margin - 1e-6
            if k == 0:
                moving = open_.link > 0  # the base stands on the table
                assert gap.min() > margin - 1e-6
                assert (plans.clearance(at[moving], cut=0.2).distance - open_.radii[moving]).min() > margin - 1e-6


def test_an_approach_starts_farther_back_where_no_plan_may_end_at_the_pregrasp_asked_for() -> None:
    target, few, margin = target_of(scene(), BOX, "box"), GraspOptions(samples=100, pregrasp=0.02), 0.05
    sampler = GraspSampler(scene(), panda(), arm_margin=margin)
    sampler.agree_with_plans(GaussianCollisionField(scene().model, 2.0))
    result = sampler.sample(target, few)
    assert result.grasps
    open_hand = RobotSpheres(panda(), T_world_base=scene().T_world_base, margin=margin)
    for g in result.grasps:
        assert g.approach_path is not None
        blocked = open_hand.check(GaussianCollisionField(scene().model, 2.0), g.approach_path).in_collision
        assert not blocked[0]
        assert blocked[1:].all()  # no nearer place is free
        start = scene().T_world_base @ panda().fk(g.approach_path[:1])[0, -1] @ panda().T_link_tcp
        assert np.abs(start - g.T_world_pregrasp).max() < 1e-3
        away = g.T_world_tcp[:3, 3] - g.T_world_pregrasp[:3, 3]
        length = np.linalg.norm(away)
        assert few.pregrasp < length <= 0.3
        assert np.abs(away - length * g.T_world_tcp[:3, 2]).max() < 1e-9
        assert (g.q_pregrasp == g.approach_path[0]).all()


INNER, OUTER, HIGH, RIM = 0.021, 0.0325, 0.016, 0.0055  # [m] of a low ring


def _low_ring() -> SegmentedMap:
    """Return a roll of tape on the table as depth shows it, 16 mm high: rounded rim, few Gaussians on its walls."""
    rng = np.random.default_rng(0)
    out = np.where(rng.random(2600) < 0.5, 1.0, -1.0)
    bent = rng.uniform(0.0, np.pi / 2, len(out)) * (rng.random(len(out)) < 0.9)  # from level to up; 0: on the wall
    down = np.where(bent > 0.0, 0.0, rng.uniform(0.0, 0.008, len(out)))
    r = np.where(out > 0, OUTER, INNER) - out * RIM * (1.0 - np.cos(bent))
    around = rng.uniform(-np.pi, np.pi, len(out))
    away = np.stack([np.cos(around), np.sin(around), 0 * around], axis=1)
    means = [0.5, 0.0, 0.0] + r[:, None] * away + np.outer(HIGH - RIM * (1.0 - np.sin(bent)) - down, [0, 0, 1])
    normals = (out * np.cos(bent))[:, None] * away + np.outer(np.sin(bent), [0, 0, 1])
    side = np.cross([0, 0, 1], away)
    quats = rotation_to_quat(np.stack([side, np.cross(normals, side), normals], axis=2))
    table = colored({}, 12_000, {})
    every = len(table) + len(means)
    model = GaussianModel.from_activated(
        means=np.r_[table.means.double().numpy(), means],
        quats=np.r_[table.quats.double().numpy(), quats],
        scales=np.r_[table.scales.double().numpy(), np.tile([1e-3, 1e-3, 2e-4], (len(means), 1))],
        opacities=np.full(every, 0.95),
        colors=np.full((every, 3), 0.5),
    )
    return segment(model, np.eye(4))


def test_a_low_ring_is_pinched_at_its_wall_by_slim_fingers_above_the_table() -> None:
    low = _low_ring()
    (ring,) = low.objects
    target = Target(ring.rows, None, "tape", "test", 1.0, (), 0)
    thick = GraspSampler(low, panda()).sample(target, GraspOptions(friction=0.7))
    slim = GraspSampler(low, panda_2f85()).sample(target, GraspOptions(friction=0.7))
    walls = [g for g in thick.grasps if np.ptp(g.contacts, axis=0).max() < OUTER - INNER]
    assert not walls  # the fingers are 26 mm thick; around the whole ring they may close
    assert slim
    hand = panda_2f85().hand
    assert hand is not None
    for g in slim.grasps:
        across = np.abs(np.linalg.norm(g.contacts[:, :2] - [0.5, 0.0], axis=1) - (INNER + OUTER) / 2)
        corner = np.stack([across - (OUTER - INNER) / 2 + RIM, g.contacts[:, 2] - HIGH + RIM])
        off = np.linalg.norm(np.maximum(corner, 0.0), axis=0) + np.minimum(corner.max(axis=0), 0.0) - RIM
        assert np.abs(off).max() < 3e-3
        assert (g.T_world_tcp[:3, 3] + hand.tip * g.T_world_tcp[:3, 2])[2] > 0.0


def test_the_counts_of_hands_add_up() -> None:
    result = grasped("can")
    hands = sum(count for reason, count in result.rejected.items() if reason.startswith("hands"))
    assert hands + len(result.grasps) <= result.candidates
    assert hands > 0.5 * result.candidates


def test_a_hand_alone_needs_no_arm() -> None:
    found = GraspSampler(scene(), panda(), hand_only=True).sample(target_of(scene(), BOX, "box")).unwrap()
    assert found.q is None
    assert "arm" not in found.terms


def test_a_neighbour_on_one_side_turns_the_hand_away_from_it() -> None:
    near: dict[str, Solid] = {
        "box": Block((0.45, 0.0, 0.05), (0.05, 0.05, 0.10)),
        "wall": Block((0.45, 0.06, 0.075), (0.12, 0.04, 0.15)),
    }
    crowded = segment(colored(near, 20_000, {}), np.eye(4))
    target = target_of(crowded, near["box"], "box")
    field = GaussianCollisionField(colored({"wall": near["wall"]}, 20_000, {}), 1.0)
    grasps = GraspSampler(crowded, panda()).sample(target).grasps
    assert grasps
    T_tcp_link = inverse(panda().T_link_tcp)
    for g in grasps:
        spheres = panda().spheres(g.opening)
        own = spheres.link == 7
        at = transform_points(g.T_world_tcp @ T_tcp_link, spheres.centers[own])
        assert field.clearance(np.c_[at, spheres.radii[own]]).distance.min() > -1e-3


def test_unobserved_sides_are_completed_and_reported() -> None:
    above = segment(seen_from_above(model()), np.eye(4))
    result = GraspSampler(above, panda()).sample(target_of(above, BOX, "box"))
    best = result.unwrap()
    assert any("completed" in note for note in result.notes)
    assert best.terms["seen"] < 0.5
    assert best.width == pytest.approx(BOX.size[1], abs=8e-3)
    assert np.abs(BOX.distance(best.contacts)).max() < 4e-3


def test_no_bottom_is_completed_above_the_support() -> None:
    """A ball that was observed from above and in front gets a back and sides down to the table, but no bottom."""
    points = model().means.double().numpy()
    own = (np.abs(BALL.distance(points)) < 1e-3) & (points[:, 2] > 1e-3)
    shown = (points - BALL.center) @ [0.5, 0.0, 1.0] > -0.2 * BALL.radius
    above = segment(model().select(torch.from_numpy(np.flatnonzero(~own | shown))), np.eye(4))
    surface = target_surface(above, target_of(above, BALL, "ball").rows)
    completed = surface.points[~surface.observed]
    assert len(completed) > 100
    down = surface.normals[~surface.observed][:, 2] < -0.7
    assert not (down & (completed[:, 2] > 0.01)).any()


def test_a_ball_is_held_across_its_middle_and_closure_is_that_of_the_pads_there() -> None:
    """Two circles that meet: a round finger end's face is turned by asin(offset / (both radii))."""
    hand = panda().hand
    assert hand is not None
    best = grasped("ball").unwrap()
    assert np.linalg.norm(best.contacts.mean(axis=0) - BALL.center) < 3e-3
    beyond = transform_points(inverse(best.T_world_tcp), np.array([BALL.center]))[0, 2] - hand.pad
    turned = np.arcsin(max(beyond, 0.0) / (BALL.radius + hand.tip - hand.pad))
    assert best.terms["closure"] == pytest.approx(1.0 - turned / np.arctan(GraspOptions().friction), abs=0.15)
    assert best.terms["closure"] > 0.6


def test_no_side_is_completed_where_depth_saw_through() -> None:
    found = segment(seen_from_above(model()), np.eye(4))
    target = target_of(found, BOX, "box")
    camera = Camera(220.0, 220.0, 159.5, 119.5, 320, 240)

    def views(*solids: Solid) -> list[DepthView]:
        stage = RaycastScene([RaycastSurface(solid_mesh(solid), Texture((0.5,) * 3, (0.5,) * 3)) for solid in solids])
        poses = [
            look_at(np.array([0.45 + 0.4 * np.cos(turn), 0.1 + 0.4 * np.sin(turn), 0.35]), np.array([0.45, 0.1, 0.05]))
            for turn in np.arange(8) * np.pi / 4
        ]
        return [(stage.render(camera, T)[1], camera, T) for T in poses]

    completed = [
        int((~target_surface(found, target.rows, views=known).observed).sum())
        for known in ((), views(TABLE, BOX), views(TABLE))
    ]
    assert completed[0] > 200
    assert completed[1] > 0.9 * completed[0]
    assert completed[2] < 0.1 * completed[0]


def test_the_same_seed_gives_the_same_grasps() -> None:
    again = sampler().sample(target_of(scene(), CAN, "can"))
    np.testing.assert_array_equal([g.T_world_tcp for g in again.grasps], [g.T_world_tcp for g in grasped("can").grasps])


@pytest.mark.parametrize(
    ("field", "value"), [("friction", 0.0), ("samples", 0), ("approach", "below"), ("pregrasp", -1.0)]
)
def test_options_out_of_range_are_refused(field: str, value: object) -> None:
    with pytest.raises(InputError, match=field):
        GraspOptions(**{field: value})  # type: ignore[arg-type]


def test_an_empty_target_is_refused() -> None:
    with pytest.raises(InputError, match="ghost"):
        sampler().sample(Target(np.zeros(0, np.int64), None, "ghost", "test", 1.0))


def test_a_grasp_far_from_the_indicated_point_is_noted() -> None:
    """Two objects are connected in the map, and the best grasp is on the one that was not indicated."""
    box, can = (target_of(scene(), OBJECTS[name], name) for name in ("box", "can"))
    at = np.array([0.50, -0.15, 0.12])
    far = sampler().sample(Target(box.rows, at, "both", "place", 1.0))
    assert any("from the indicated point" in note for note in far.notes)
    near = sampler().sample(Target(can.rows, at, "can", "place", 1.0))
    assert not any("from the indicated point" in note for note in near.notes)


def test_the_edge_of_a_low_object_stays_sharp_where_only_similar_normals_are_averaged() -> None:
    low = _low_ring()
    off = []
    for sharp in (False, True):
        surface, _ = measured_surface(low, low.objects[0].rows, sharp=sharp)
        r = np.linalg.norm(surface.points[:, :2] - [0.5, 0.0], axis=1)
        wall = (surface.points[:, 2] < HIGH - 0.6 * RIM) & (r > (INNER + OUTER) / 2)
        off.append(np.degrees(np.median(np.abs(np.arcsin(surface.normals[wall, 2])))))
    assert off[1] < 0.8 * off[0]


def test_closed_fingers_that_would_touch_a_neighbour_are_refused_although_the_open_hand_is_free() -> None:
    """A ball between the open fingers is where one of them ends."""
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = (0.5, 0.0, 0.3)
    above = T.copy()
    above[2, 3] += 0.1
    ball = sphere_gaussians(np.array([[0.5, 0.02, 0.3]]), np.array([0.003]), np.array([0.5, 0.5, 0.5]), 0.99)
    free = ArmReach(panda(), np.eye(4), GaussianCollisionField(GaussianModel.empty(0)))
    near = ArmReach(panda(), np.eye(4), GaussianCollisionField(ball))
    assert free.reach(T, above, 0.08, 0.02).q is not None
    assert near.reach(T, above, 0.08, 0.076).q is not None
    reached = near.reach(T, above, 0.08, 0.02)
    assert reached.q is None
    assert reached.kind == "close in the surroundings"

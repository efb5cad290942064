"""Hands against raw depth: penetration by closed form, contacts without depth, obstacles that only depth shows."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from splatbot.bench.collision.peers import solid_mesh
from splatbot.bench.tabletop import Block, Solid
from splatbot.camera import Camera
from splatbot.collision.confirmed import confirmed_near
from splatbot.collision.visibility import DepthView
from splatbot.geometry import look_at, se3_exp, transform_points
from splatbot.grasping.advice import first_change
from splatbot.grasping.hands import Hands
from splatbot.grasping.measured import CONSTANTS, RawDepth, closed_width, contact_distances, hand_penetration
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.sampler import GraspSampler
from splatbot.grasping.score import confidence
from splatbot.grasping.summary import summary
from splatbot.grasping.types import GraspResult, NoGraspError
from splatbot.logs.raycast import RaycastScene, RaycastSurface
from splatbot.logs.textures import Texture
from splatbot.protocols import Array, HandShape
from splatbot.robots.panda import panda
from tests.unit.grasping.objects import BOX, OBJECTS, TABLE, scene, target_of

FLOOR, QUAD = 1e-3, 1.4e-3
CAMERA = Camera(300.0, 300.0, 159.5, 119.5, 320, 240)
HAND = panda().hand


def views(*solids: Solid, turns: Array | None = None) -> list[DepthView]:
    """Render exact depth images of solids from a ring around the box."""
    stage = RaycastScene([RaycastSurface(solid_mesh(solid), Texture((0.5,) * 3, (0.5,) * 3)) for solid in solids])
    angles = np.arange(12) * np.pi / 6 if turns is None else turns
    eyes = [np.array([0.45 + 0.4 * np.cos(turn), 0.1 + 0.4 * np.sin(turn), 0.35]) for turn in angles]
    poses = [look_at(eye, np.array([0.45, 0.1, 0.05])) for eye in eyes]
    return [(stage.render(CAMERA, T)[1], CAMERA, T) for T in poses]


def raw(*solids: Solid, turns: Array | None = None) -> RawDepth:
    return RawDepth(tuple(views(*solids, turns=turns)), FLOOR, QUAD)


@cache
def everything() -> RawDepth:
    return raw(TABLE, *OBJECTS.values())


@cache
def grasps_with(depth: RawDepth | None) -> GraspResult:
    return GraspSampler(scene(), panda(), raw=depth, hand_only=True).sample(target_of(scene(), BOX, "box"))


def by_boxes(points: Array, opening: float, hand: HandShape, retreat: float) -> float:
    """Compute the penetration (float64) of each point: its distance from the nearest face, without the rear."""
    deepest = 0.0
    rear = -hand.palm - retreat
    for x, y, z in points:
        for low, high in ((opening / 2, opening / 2 + hand.thickness), (-opening / 2 - hand.thickness, -opening / 2)):
            faces = (hand.width / 2 - x, x + hand.width / 2, y - low, high - y, hand.tip - z)
            if min(*faces, z - rear) > 0:
                deepest = max(deepest, min(faces))
        w, d = hand.palm_size
        faces = (w / 2 - x, x + w / 2, y + d / 2, d / 2 - y, -hand.palm - z)
        if min(*faces, z - rear) > 0:
            deepest = max(deepest, min(faces))
    return deepest


@pytest.mark.parametrize("seed", range(6))
@pytest.mark.parametrize("retreat", [0.0, 0.1])
def test_penetration_equals_the_distance_from_the_nearest_face_in_float64(seed: int, retreat: float) -> None:
    assert HAND is not None
    rng = np.random.default_rng(seed)
    T = se3_exp(np.r_[rng.uniform(-2, 2, 3), rng.uniform(-1.5, 1.5, 3)])
    local = rng.uniform((-0.06, -0.1, -0.25), (0.06, 0.1, 0.05), (60, 3))
    opening = float(rng.uniform(0.0, 0.08))
    got = hand_penetration(Hands.one(T, opening), transform_points(T, local), HAND, retreat=retreat)
    assert got[0] == pytest.approx(by_boxes(local, opening, HAND, retreat), abs=2e-6)  # float32 at 2 m


@pytest.mark.parametrize("seed", range(4))
def test_fingers_stop_where_a_point_would_be_deeper_than_the_tolerance(seed: int) -> None:
    assert HAND is not None
    rng = np.random.default_rng(seed)
    T = se3_exp(np.r_[rng.uniform(-2, 2, 3), rng.uniform(-1.5, 1.5, 3)])
    local = rng.uniform((-0.02, -0.03, -0.04), (0.02, 0.03, 0.02), (60, 3))
    at = Hands.one(T, 0.08)
    width = float(closed_width(at, transform_points(T, local), HAND)[0])
    assert by_boxes(local, width, HAND, 0.0) <= CONSTANTS.pad_penetration + 2e-6
    assert by_boxes(local, width - 1e-4, HAND, 0.0) > CONSTANTS.pad_penetration
    assert CONSTANTS.pad_penetration < CONSTANTS.max_penetration


def test_depth_between_the_pads_and_no_depth_at_all_are_no_penetration() -> None:
    assert HAND is not None
    T = np.eye(4)
    between = np.array([[0.0, 0.0, 0.0], [0.004, 0.019, 0.003]])
    assert hand_penetration(Hands.one(T, 0.04), between, HAND, retreat=0.1)[0] == 0.0
    assert hand_penetration(Hands.one(T, 0.04), np.zeros((0, 3)), HAND, retreat=0.1)[0] == 0.0
    assert np.isinf(contact_distances(np.zeros((2, 3)), np.zeros((0, 3)))).all()


def test_confirmed_points_are_on_the_surface_and_dense() -> None:
    low, high = np.array([0.36, 0.0, -0.01]), np.array([0.56, 0.2, 0.14])
    points = confirmed_near(views(TABLE, BOX), low, high, floor=FLOOR, quad=QUAD, spacing=0.002, most=60_000)
    assert ((points > low) & (points < high)).all()
    away = np.minimum(np.abs(BOX.distance(points)), np.abs(TABLE.distance(points)))
    assert away.max() < 3 * (FLOOR + QUAD)
    u, v = np.meshgrid(np.linspace(-0.045, 0.045, 10), np.linspace(-0.025, 0.025, 6))
    turn = np.array([[np.cos(0.4), -np.sin(0.4)], [np.sin(0.4), np.cos(0.4)]])
    top = np.c_[np.stack([u.ravel(), v.ravel()], axis=1) @ turn.T + [0.45, 0.10], np.full(u.size, 0.12)]
    assert np.abs(BOX.distance(top)).max() < 1e-9
    assert contact_distances(top, points).max() < 0.003
    assert len(confirmed_near(views(TABLE, BOX), low, high, floor=FLOOR, quad=QUAD, spacing=0.002, most=500)) <= 500


@pytest.mark.parametrize("seed", range(6))
def test_the_dense_check_finds_the_deepest_of_all_pixels_however_many_the_surroundings_have(
    seed: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert HAND is not None
    rng = np.random.default_rng(seed)
    depth, retreat = everything(), 0.1
    T = np.diag([1.0, -1.0, -1.0, 1.0])  # downwards
    T[:3, 3] = [0.45 + rng.uniform(-0.03, 0.03), 0.1 + rng.uniform(-0.03, 0.03), 0.115]
    one = Hands.one(T, 0.06)
    corners = np.array([[0.25, -0.1, 0.0], [0.65, 0.3, 0.4]])
    every = confirmed_near(depth.views, *corners, floor=FLOOR, quad=QUAD, spacing=1e-5, most=10**7)
    deepest = float(hand_penetration(one, every, HAND, retreat=retreat)[0])
    assert deepest > CONSTANTS.max_penetration
    few = len(depth.along_approach(one, HAND, retreat))
    monkeypatch.setattr("splatbot.grasping.measured.CONSTANTS", replace(CONSTANTS, max_points=few * 4))
    found = hand_penetration(one, depth.along_approach(one, HAND, retreat), HAND, retreat=retreat)
    assert deepest - 1.5e-3 <= found[0] <= deepest + 1e-6


def test_grasps_lie_on_their_approach_and_no_measured_point_is_too_deep_in_them() -> None:
    assert HAND is not None
    depth = everything()
    for grasp in grasps_with(depth).grasps:
        way = grasp.T_world_tcp[:3, 3] - grasp.T_world_pregrasp[:3, 3]
        along = float(way @ grasp.T_world_tcp[:3, 2])
        np.testing.assert_allclose(way, along * grasp.T_world_tcp[:3, 2], atol=1e-9)
        assert along == pytest.approx(GraspOptions().pregrasp, abs=1.1e-3)
        one = Hands.one(grasp.T_world_tcp, grasp.opening)
        points = depth.along_approach(one, HAND, along)
        assert hand_penetration(one, points, HAND, retreat=along)[0] <= CONSTANTS.max_penetration


def test_two_frames_confirm_nothing() -> None:
    pair = raw(TABLE, BOX, turns=np.array([0.0, 0.3]))
    assert HAND is not None
    assert len(pair.around(np.array([[0.45, 0.1, 0.06]]), HAND)) == 0


def test_no_hand_is_offered_in_an_obstacle_that_only_depth_shows() -> None:
    assert HAND is not None
    blocked = raw(TABLE, *OBJECTS.values(), Block((0.45, 0.10, 0.09), (0.02, 0.16, 0.02), 0.4))  # across the box
    before, after = grasps_with(None), grasps_with(blocked)
    measured = blocked.around(box_points(), HAND)

    def deep(result: GraspResult) -> list[float]:
        return [
            float(hand_penetration(Hands.one(g.T_world_tcp, g.opening), measured, HAND, retreat=0.1)[0])
            for g in result.grasps
        ]

    assert max(deep(before)) > 2 * CONSTANTS.max_penetration  # the map does not show it
    assert max(deep(after), default=0.0) <= CONSTANTS.max_penetration
    assert after.rejected["hands are in measured depth"] > 0


def box_points() -> Array:
    return scene().model.means.double().numpy()[target_of(scene(), BOX, "box").rows]


def test_contacts_on_a_side_that_no_frame_saw_are_implied() -> None:
    full, half = grasps_with(everything()), grasps_with(raw(TABLE, *OBJECTS.values(), turns=np.linspace(-1.2, 0.0, 8)))
    assert full.grasps
    assert half.grasps
    assert not any(any(g.implied) for g in full.grasps)
    assert any(any(g.implied) for g in half.grasps)
    for g in half.grasps:
        assert g.depth_distance is not None
        assert g.implied == tuple(g.depth_distance > CONSTANTS.contact_distance)
        assert g.terms["measured"] == pytest.approx(1.0 - np.mean(g.implied))


def _over_the_box(yaw: float) -> Hands:
    """Return a hand above the box that closes along ``yaw``, with a finger on each side."""
    T = np.eye(4)
    T[:3, 1], T[:3, 2] = [np.cos(yaw), np.sin(yaw), 0], [0, 0, -1]
    T[:3, 0] = np.cross(T[:3, 1], T[:3, 2])
    T[:3, 3] = [0.45, 0.1, 0.06]
    return Hands.one(T, 0.08)


@pytest.mark.parametrize("yaw", np.linspace(0.0, 2 * np.pi, 5)[:-1])
def test_a_finger_in_the_shadow_of_the_object_is_unseen_and_the_one_before_it_is_seen(yaw: float) -> None:
    assert HAND is not None
    tall = Block(center=(0.45, 0.1, 0.1), size=(0.06, 0.06, 0.2), yaw=0.0)
    one_side = raw(TABLE, tall, turns=np.array([yaw]))  # the camera is where the fingers close along
    behind, before = one_side.unseen(_over_the_box(yaw), HAND)[0]
    assert behind > 0.95
    assert before == 0.0
    around = raw(TABLE, tall).unseen(_over_the_box(yaw), HAND)
    assert around.max() == 0.0
    assert RawDepth((), FLOOR, QUAD).unseen(_over_the_box(yaw), HAND).min() == 1.0


def test_pixels_without_depth_show_no_free_space() -> None:
    assert HAND is not None
    depth, camera, T = views(TABLE)[0]
    hand = _over_the_box(0.0)
    assert RawDepth(((depth, camera, T),), FLOOR, QUAD).unseen(hand, HAND).max() == 0.0
    assert RawDepth(((np.zeros_like(depth), camera, T),), FLOOR, QUAD).unseen(hand, HAND).min() == 1.0
    assert RawDepth(((np.full_like(depth, np.nan), camera, T),), FLOOR, QUAD).unseen(hand, HAND).min() == 1.0


@pytest.mark.long
def test_a_finger_that_enters_unseen_space_is_not_offered() -> None:
    half = raw(TABLE, *OBJECTS.values(), turns=np.linspace(-0.4, 0.4, 6))
    result = grasps_with(half)
    assert not any(any(g.blind) for g in result.grasps)
    allowed = GraspSampler(scene(), panda(), raw=half, hand_only=True).sample(
        target_of(scene(), BOX, "box"), GraspOptions(accept_implied=True, wanted=100, samples=200)
    )
    hidden = [g for g in allowed.grasps if any(g.blind)]
    assert hidden
    for g in hidden:
        assert g.depth_distance is not None
        assert g.unseen is not None
        assert ((g.depth_distance > CONSTANTS.unseen_from) & (g.unseen > CONSTANTS.max_unseen)).any()
    every = grasps_with(everything())
    assert every.grasps
    assert not every.doubtful


@pytest.mark.long
def test_an_implied_side_needs_more_free_space_at_the_pad(monkeypatch: pytest.MonkeyPatch) -> None:
    from splatbot.grasping import doubts

    half, target = raw(TABLE, *OBJECTS.values(), turns=np.linspace(-1.2, 0.0, 8)), target_of(scene(), BOX, "box")
    assert HAND is not None
    gap = 0.5 * (HAND.stroke - BOX.size[1]) + 0.002  # more than the box leaves
    monkeypatch.setattr(doubts, "CONSTANTS", replace(CONSTANTS, implied_gap=gap))
    few = GraspOptions(samples=150)
    result = GraspSampler(scene(), panda(), raw=half, hand_only=True).sample(target, few)
    assert not any(any(g.implied) and g.width > HAND.stroke - 2 * gap for g in result.grasps)
    assert result.doubtful
    assert "wide at an implied contact, too close to the 80 mm that the hand opens" in result.doubtful[0].rejected
    if not result.grasps:
        assert "opens wider" in first_change(result, scene(), HAND.stroke)[1]
    every = GraspSampler(scene(), panda(), raw=everything(), hand_only=True).sample(target, few)
    assert every.grasps  # its sides are measured
    assert not any("implied contact" in g.rejected for g in every.doubtful)


def test_results_state_the_support_of_each_contact_and_null_where_it_was_not_checked() -> None:
    known = summary(grasps_with(everything()))["grasps"][0]
    assert known["contact_implied"] == [False, False]
    assert all(0.0 <= away <= CONSTANTS.contact_distance for away in known["contact_depth_distance_m"])
    unknown = summary(grasps_with(None))["grasps"][0]
    assert unknown["contact_implied"] is None
    assert unknown["contact_depth_distance_m"] is None


def test_grasps_without_any_contact_at_measured_depth_are_not_offered_but_named() -> None:
    result = grasps_with(RawDepth((), FLOOR, QUAD))
    assert not result.grasps
    with pytest.raises(NoGraspError, match="no grasp that should be executed; 10 fit the map"):
        result.unwrap()
    doubtful = summary(result)["doubtful"]
    assert len(doubtful) == 10
    assert doubtful[0]["contact_implied"] == [True, True]
    assert doubtful[0]["contact_depth_distance_m"] == [None, None]
    assert doubtful[0]["rejected"] == "has no contact at measured depth, nor any depth near it"
    reason, change = first_change(result, scene(), 0.08)
    assert reason.startswith("10 grasps fit the map, but the best of them has no contact at measured depth")
    assert change == "map it again from more sides, or allow such grasps (--accept-implied)"
    allowed = GraspSampler(scene(), panda(), raw=RawDepth((), FLOOR, QUAD), hand_only=True).sample(
        target_of(scene(), BOX, "box"), GraspOptions(accept_implied=True)
    )
    assert len(allowed.grasps) == 10
    assert all(g.implied == (True, True) for g in allowed.grasps)
    assert not allowed.doubtful


def test_grasps_of_less_than_the_least_confidence_are_not_offered_but_named() -> None:
    target = target_of(scene(), BOX, "box")
    sampler = GraspSampler(scene(), panda(), hand_only=True)
    every = sampler.sample(target, GraspOptions(min_confidence=0.0))
    least = float(np.median([g.confidence for g in every.grasps]))
    some = sampler.sample(target, GraspOptions(min_confidence=least))
    assert not every.doubtful
    assert some.grasps
    assert some.doubtful
    assert min(g.confidence for g in some.grasps) >= least > max(g.confidence for g in some.doubtful)
    assert all(g.rejected.endswith(f"less than {least:g}") for g in some.doubtful)
    none = sampler.sample(target, GraspOptions(min_confidence=1.0))
    assert not none.grasps
    reason, change = first_change(none, scene(), 0.08)
    assert "has a confidence of" in reason
    assert change == "take another hand, or allow such grasps (--min-confidence)"


def test_confidence_grows_with_the_score_between_0_and_1() -> None:
    values = [confidence(total) for total in np.linspace(0.0, 1.0, 11)]
    assert values == sorted(values)
    assert 0.0 < values[0] < 0.1
    assert 0.99 < values[-1] < 1.0

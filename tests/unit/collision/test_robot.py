"""The arm of spheres against float64 and against analytic truth."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
import torch

from splatbot._native import ARM_ROUNDING, available_isas, set_isa
from splatbot.bench.tabletop import tabletop
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.geometry import pose_from_quat
from splatbot.protocols import KinematicChain, LinkSpheres
from splatbot.robots.panda import panda
from tests.unit.collision.oracle import Array, gaussians

SCENE = tabletop()
T_WORLD_BASE = pose_from_quat([0.3, -0.2, 0.1], [0.9, 0.1, -0.2, 0.3])


@pytest.fixture(scope="module")
def field() -> GaussianCollisionField:
    """The table top as 20,000 Gaussians."""
    return GaussianCollisionField(SCENE.gaussians(20_000))


@pytest.fixture(params=available_isas())
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Each instruction set that this CPU runs."""
    set_isa(request.param)
    yield request.param
    set_isa("")


def _clearance(arm: RobotSpheres, q: Array) -> Array:
    """Compute the least distance (C,) of the arm's spheres without the base from the true shapes."""
    moving = arm.spheres.link > 0
    distance = SCENE.distance(arm.centers(q)[:, moving].reshape(-1, 3)).reshape(len(q), -1)
    return np.asarray((distance - arm.spheres.radii[moving]).min(axis=1))


def _self_gap(arm: RobotSpheres, q: Array) -> Array:
    """Compute the least gap (C,) between spheres of links that may not touch."""
    at, radii, link = torch.from_numpy(arm.centers(q)), arm.spheres.radii, arm.spheres.link
    gaps = []
    for a, b in arm.pairs:
        i, j = np.flatnonzero(link == a), np.flatnonzero(link == b)
        apart = torch.cdist(at[:, i], at[:, j], compute_mode="donot_use_mm_for_euclid_dist")
        gaps.append((apart.numpy() - (radii[i, None] + radii[j])).reshape(len(q), -1).min(axis=1))
    return np.asarray(np.min(gaps, axis=0))


@cache
def _room(q: bytes) -> Array:
    """Compute the clearance (C,) of configurations of the Panda, for all instruction sets once."""
    return _clearance(RobotSpheres(panda()), np.frombuffer(q).reshape(-1, 7))


@cache
def _least_gap(start: bytes, end: bytes) -> float:
    """Compute the least gap on an edge at 300 places, for all instruction sets once."""
    a, b, arm = np.frombuffer(start), np.frombuffer(end), RobotSpheres(panda())
    dense = a + np.linspace(0, 1, 300)[:, None] * (b - a)
    return float(min(_clearance(arm, dense).min(), _self_gap(arm, dense).min()))


def test_spheres_are_where_the_links_are_and_float32_is_within_the_stated_micrometre(isa: str) -> None:
    rng = np.random.default_rng(0)
    arm = RobotSpheres(panda(), T_world_base=T_WORLD_BASE)
    q = panda().random(5000, rng)
    T = T_WORLD_BASE @ panda().fk(q[:50])
    np.testing.assert_allclose(arm.forward(q[:50]), T, atol=1e-12)
    s = arm.spheres
    own = T[:, s.link]
    expected = np.einsum("csij,sj->csi", own[..., :3, :3], s.centers) + own[..., :3, 3]
    np.testing.assert_allclose(arm.centers(q[:50]), expected, atol=1e-12)
    apart = np.linalg.norm(arm.native.centers_float(q) - arm.centers(q), axis=-1)
    assert apart.max() < ARM_ROUNDING


def test_no_configuration_that_touches_the_true_shapes_is_called_free(field: GaussianCollisionField, isa: str) -> None:
    rng = np.random.default_rng(1)
    arm = RobotSpheres(panda())
    q = panda().random(20_000, rng)
    answer = arm.check(field, q)
    room = _room(q.tobytes())
    assert not (~answer.in_collision & (room <= 0)).any()
    own = arm.check(None, q).in_collision
    assert (answer.in_collision & ~own & (room > 0.02)).sum() == 0
    assert 0.2 < answer.in_collision.mean() < 0.6


def test_self_collision_is_that_of_the_spheres(isa: str) -> None:
    rng = np.random.default_rng(2)
    arm = RobotSpheres(panda())
    q = panda().random(3000, rng)
    gap = _self_gap(arm, q)
    hit = arm.check(None, q)
    assert hit.in_collision[gap <= 0].all()
    assert not hit.in_collision[gap > 5e-6].any()
    assert (hit.link[hit.in_collision] > hit.other[hit.in_collision]).all()
    assert (hit.link[~hit.in_collision] == -1).all()


def test_the_link_that_is_named_touches_the_map(field: GaussianCollisionField) -> None:
    rng = np.random.default_rng(3)
    arm = RobotSpheres(panda())
    q = panda().random(2000, rng)
    answer = arm.check(field, q)
    touching = np.flatnonzero(answer.in_collision & (answer.other == -1))
    assert len(touching) > 50
    for i in touching[:50]:
        own = arm.spheres.link == answer.link[i]
        spheres = np.c_[arm.centers(q[i])[0, own], arm.spheres.radii[own] + 2e-6]
        assert field.in_collision(spheres).any()


def test_clearance_is_the_least_of_all_spheres_and_its_gradient_that_of_finite_differences(
    field: GaussianCollisionField,
) -> None:
    rng = np.random.default_rng(4)
    arm = RobotSpheres(panda(), T_world_base=T_WORLD_BASE)
    q = panda().random(200, rng)
    answer = arm.clearance(field, q)
    moving = arm.spheres.link > 0
    spheres = np.concatenate([arm.centers(q)[:, moving], np.tile(arm.spheres.radii[moving], (200, 1))[..., None]], -1)
    brute = field.clearance(spheres.reshape(-1, 4)).distance.reshape(200, -1)
    np.testing.assert_allclose(answer.distance, brute.min(axis=1), atol=1e-5)
    h, steps = 1e-5, np.eye(7)
    ahead = np.stack([arm.clearance(field, q + h * e).distance for e in steps], axis=-1)
    behind = np.stack([arm.clearance(field, q - h * e).distance for e in steps], axis=-1)
    two = np.sort(brute, axis=1)[:, :2]
    smooth = (two[:, 1] - two[:, 0] > 1e-3) & (np.abs(ahead + behind - 2 * answer.distance[:, None]).max(axis=1) < 1e-8)
    assert smooth.sum() > 50
    error = np.abs((ahead - behind) / (2 * h) - answer.gradient)[smooth]
    assert np.median(error.max(axis=1)) < 1e-4
    assert (error.max(axis=1) < 2e-3).mean() > 0.95
    cut = arm.clearance(field, q, cut=0.05)
    assert np.isinf(cut.distance[answer.distance > 0.051]).all()
    assert (cut.gradient[answer.distance > 0.051] == 0).all()


def test_an_edge_that_is_certified_is_free_all_along_and_hits_are_not_far_off(
    field: GaussianCollisionField, isa: str
) -> None:
    rng = np.random.default_rng(5)
    arm = RobotSpheres(panda())
    q = panda().random(3000, rng)
    start = q[~arm.check(field, q).in_collision][:500]
    step = rng.normal(size=start.shape)
    end = start + step / np.linalg.norm(step, axis=1, keepdims=True)
    answer = arm.certify(field, start, end)
    assert 0.1 < answer.in_collision.mean() < 0.9
    free = ~answer.in_collision
    for a, b in zip(start[free][:60], end[free][:60], strict=True):
        assert _least_gap(a.tobytes(), b.tobytes()) > 0
    sampled = arm.sample(field, start, end, samples=513).in_collision
    assert not (sampled & free).any()  # an edge with a colliding sample has no certificate
    assert (answer.in_collision & ~sampled).mean() < 0.05
    assert (answer.at[free] == 1).all()


def test_a_plate_thinner_than_the_steps_between_samples_stops_a_certified_edge_alone() -> None:
    rng = np.random.default_rng(6)
    plate = np.c_[np.full(2000, 0.40), rng.uniform(-0.3, 0.3, 2000), rng.uniform(0.3, 0.9, 2000)]
    field = GaussianCollisionField(gaussians(plate, (2.5e-4, 0.02, 0.02)), 2.0)
    # Two balls of 5 mm are the robot: they pass the plate between two samples.
    arm = RobotSpheres(_Stick())
    start, end = np.array([[-0.8]]), np.array([[0.8]])
    assert not arm.sample(field, start, end, samples=12).in_collision[0]
    assert arm.certify(field, start, end).in_collision[0]


def test_a_certificate_speaks_of_self_collision_too() -> None:
    arm = RobotSpheres(panda())
    start = np.array([[0.0, 1.2, 0.0, -1.0, 0.0, 1.9, 0.0]])
    end = np.array([[0.0, 1.2, 0.0, -3.05, 0.0, 0.4, 0.0]])
    dense = start + np.linspace(0, 1, 200)[:, None] * (end - start)
    assert _self_gap(arm, start)[0] > 0
    expected = bool((_self_gap(arm, dense) <= 0).any())
    answer = arm.certify(None, start, end)
    assert answer.in_collision[0] == expected
    assert answer.map_version == -1


def test_what_the_gripper_holds_is_tested_and_so_is_how_wide_it_is_open(field: GaussianCollisionField) -> None:
    rng = np.random.default_rng(7)
    q = panda().random(4000, rng)
    narrow = RobotSpheres(panda(), opening=0.0)
    holding = RobotSpheres(panda(), opening=0.0, attached=[[0.0, 0.0, 0.35, 0.1]])
    wide = RobotSpheres(panda())
    bare = narrow.check(field, q).in_collision
    assert holding.check(field, q).in_collision[bare].all()
    assert holding.check(field, q).in_collision.sum() > bare.sum()
    assert (wide.check(field, q).in_collision != bare).any()
    margin = RobotSpheres(panda(), opening=0.0, margin=0.02)
    assert margin.check(field, q).in_collision[bare].all()


def test_a_margin_is_room_to_the_map_and_not_to_the_arm_itself(field: GaussianCollisionField, isa: str) -> None:
    rng = np.random.default_rng(9)
    q = panda().random(3000, rng)
    bare, wide = RobotSpheres(panda()), RobotSpheres(panda(), margin=0.03)
    np.testing.assert_array_equal(bare.check(None, q).in_collision, wide.check(None, q).in_collision)
    apart = q[~bare.check(None, q).in_collision]
    room = bare.clearance(field, apart).distance
    np.testing.assert_allclose(wide.clearance(field, apart).distance, room - 0.03, atol=2e-6)
    hit = wide.check(field, apart).in_collision
    assert hit[room <= 0.03].all()
    assert not hit[room > 0.03 + 1e-4].any()
    start = apart[room > 0.03][:100]
    end = start + 0.1
    free = ~wide.certify(field, start, end).in_collision
    assert free.any()
    middle = start + 0.5 * (end - start)
    assert (bare.clearance(field, middle[free]).distance > 0.03).all()


def test_a_base_stands_on_the_map_with_its_foot_alone(field: GaussianCollisionField) -> None:
    assert not RobotSpheres(panda()).base_in_map_above(field, 0.03)
    sunk = RobotSpheres(panda(), T_world_base=pose_from_quat([0.5, 0.0, -0.1], [1.0, 0.0, 0.0, 0.0]))
    assert sunk.base_in_map_above(field, 0.03)
    assert not sunk.base_in_map_above(field, 0.2)


def test_a_robot_and_a_map_moved_together_give_the_same_answers() -> None:
    rng = np.random.default_rng(8)
    model = SCENE.gaussians(5000)
    q = panda().random(2000, rng)
    before = RobotSpheres(panda()).check(GaussianCollisionField(model), q).in_collision
    T = np.eye(4)
    T[:3, 3] = [512.0, -256.0, 128.0]
    model.means += model.means.new_tensor(T[:3, 3])
    after = RobotSpheres(panda(), T_world_base=T).check(GaussianCollisionField(model), q).in_collision
    assert (before != after).mean() < 2e-3  # means are rounded to 60 um there
    room = _clearance(RobotSpheres(panda()), q)
    assert not (~after & (room <= 0)).any()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"T_world_base": np.ones((4, 4))}, "no rotation"),
        ({"attached": [[0, 0, 0, -1.0]]}, "attached"),
        ({"margin": -0.1}, "margin"),
    ],
)
def test_what_makes_no_sense_is_named(arguments: dict[str, object], message: str) -> None:
    with pytest.raises(InputError, match=message):
        RobotSpheres(panda(), **arguments)  # type: ignore[arg-type]


def test_edges_and_configurations_of_other_arms_are_refused(field: GaussianCollisionField) -> None:
    arm = RobotSpheres(panda())
    with pytest.raises(InputError, match="q: is"):
        arm.check(field, np.zeros((3, 6)))
    with pytest.raises(InputError, match="end: has 1 rows"):
        arm.certify(field, np.zeros((2, 7)), np.zeros((1, 7)))
    with pytest.raises(InputError, match="not finite"):
        arm.check(field, np.full((1, 7), np.nan))


class _Stick:
    """One joint about z, half a metre below a ball of 5 mm at 0.6 m."""

    name = "stick"

    def __init__(self) -> None:
        T = np.eye(4)
        T[:3, :3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]]  # its axis along -y
        T[2, 3] = 0.6
        one = np.ones(1)
        self.chain = KinematicChain(("turn",), T[None], np.array([False]), -3 * one, 3 * one, one, one, one, one)
        self._spheres = LinkSpheres(np.ones(1, np.int32), np.array([[0.45, 0.0, 0.0]]), np.array([0.005]))
        self.self_collision_pairs = np.zeros((0, 2), np.int32)
        self.home = np.zeros(1)

    def spheres(self, opening: float | None = None) -> LinkSpheres:
        return self._spheres

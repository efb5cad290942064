"""The collision field where the plain formulas fail: flat, thin, huge, far, coincident, damaged."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.spatial.transform import Rotation

from splatbot.bench.tabletop import tabletop
from splatbot.collision import GaussianCollisionField, RobotSpheres, capsules_in_collision
from splatbot.collision.solids import SCALE_FLOOR
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.robots.panda import panda
from tests.unit.collision.oracle import Array, gaussians, local, moved, random_gaussians, signed_distances

UNDER, ROUNDED_UP = 4e-6, 1e-6  # of ClearanceResult


def _certified(field: GaussianCollisionField, model: GaussianModel, points: Array, n_sigma: float = 2.0) -> None:
    """Check the error bound of ClearanceResult, and that collision checks are conservative."""
    found = field.clearance(points).distance
    v, a = local(model, n_sigma, points)
    truth = signed_distances(v, a)
    nearest, rows = truth.argmin(axis=1), np.arange(len(points))
    least = truth.min(axis=1)
    assert (found <= least).all()
    bound = UNDER * (np.abs(v[rows, nearest]).sum(axis=-1) + a[nearest].min(axis=-1))
    assert (found >= least - bound - ROUNDED_UP * a[nearest].max(axis=-1)).all()
    hit = field.in_collision(points)
    assert hit[least <= 0].all()


@pytest.mark.parametrize("thickness", [1e-12, 1e-6, 1e-4, 1e-3])
def test_flat_discs_have_the_distance_of_a_disc(thickness: float) -> None:
    rng = np.random.default_rng(0)
    model = gaussians([0, 0, 0], (0.1, 0.1, thickness))
    field = GaussianCollisionField(model)
    points = rng.uniform(-0.5, 0.5, (500, 3))
    _certified(field, model, points)
    r, z = np.hypot(points[:, 0], points[:, 1]), np.abs(points[:, 2])
    disc = np.hypot(np.maximum(r - 0.2, 0), z)
    thick = 2 * max(thickness, SCALE_FLOOR)
    np.testing.assert_allclose(field.clearance(points).distance, disc, atol=1.01 * thick + 1e-5)


def test_needles_have_the_distance_of_a_segment() -> None:
    rng = np.random.default_rng(1)
    model = gaussians([0, 0, 0], (0.15, 1e-5, 1e-5))
    field = GaussianCollisionField(model)
    points = rng.uniform(-0.5, 0.5, (500, 3))
    _certified(field, model, points)
    along = np.clip(points[:, 0], -0.3, 0.3)
    segment = np.linalg.norm(points - np.c_[along, np.zeros((500, 2))], axis=1)
    np.testing.assert_allclose(field.clearance(points).distance, segment, atol=1.5e-4)


def test_every_mixture_of_semi_axes_from_a_tenth_of_a_millimetre_to_fifty_metres() -> None:
    rng = np.random.default_rng(2)
    scales = np.exp(rng.uniform(np.log(SCALE_FLOOR), np.log(25.0), (60, 3)))
    for i in range(60):
        model = gaussians([0, 0, 0], scales[i], rng.normal(size=(1, 4)))
        reach = np.exp(rng.uniform(np.log(1e-4), np.log(60.0), (100, 1)))
        points = rng.normal(size=(100, 3)) * reach
        _certified(GaussianCollisionField(model), model, points)


def test_huge_gaussians_do_not_change_the_answers() -> None:
    rng = np.random.default_rng(3)
    model = tabletop().gaussians(20_000)
    huge = gaussians(
        rng.uniform([-30, -30, -90], [30, 30, -30], (100, 3)), rng.uniform(1, 10, (100, 3)), rng.normal(size=(100, 4))
    )
    both = GaussianModel.concatenate([model, huge])
    alone, mixed = GaussianCollisionField(model), GaussianCollisionField(both)
    points = rng.uniform([0, -0.5, 0], [1, 0.7, 0.6], (500, 3))
    away = GaussianCollisionField(huge).clearance(points).distance
    np.testing.assert_allclose(mixed.clearance(points).distance, np.minimum(alone.clearance(points).distance, away))
    assert (mixed.native.grid_bounds(points) <= np.maximum(mixed.clearance(points).distance, 0)).all()


@pytest.mark.parametrize("away", [1e3, 1e5])
def test_a_map_a_kilometre_and_more_away_answers_as_exactly_as_its_means_are(away: float) -> None:
    rng = np.random.default_rng(4)
    model = random_gaussians(300, rng)
    model.means += torch.tensor([away, -away / 2, away / 4])
    points = model.means.double().numpy()[:200] + rng.normal(0, 0.05, (200, 3))
    _certified(GaussianCollisionField(model), model, points)


def test_a_map_with_parts_a_kilometre_apart_is_certified_in_both() -> None:
    rng = np.random.default_rng(5)
    near, far = random_gaussians(200, rng), random_gaussians(200, rng)
    far.means += 1000.0
    model = GaussianModel.concatenate([near, far])
    points = model.means.double().numpy()[::4] + rng.normal(0, 0.05, (100, 3))
    _certified(GaussianCollisionField(model), model, points)


@pytest.mark.parametrize("radius", [0.0, 1e-6, 10.0])
def test_spheres_of_no_size_and_of_ten_metres(radius: float) -> None:
    rng = np.random.default_rng(6)
    model = random_gaussians(200, rng)
    points = rng.normal(size=(200, 3)) * (1.0 + radius)
    field = GaussianCollisionField(model)
    spheres = np.c_[points, np.full(200, radius)]
    truth = signed_distances(*local(model, 2.0, points)).min(axis=1) - radius
    found = field.clearance(spheres).distance
    assert (found <= truth + 1e-12).all()
    np.testing.assert_allclose(found, truth, atol=2e-4)
    hit = field.in_collision(spheres)
    assert hit[truth <= 0].all()
    assert not hit[truth > 2e-4].any()


@pytest.mark.parametrize("margin", [1e3, 1e18, 1e20, 1e38, 1e300])
@pytest.mark.parametrize("count", [1, 3, 2500])
def test_a_margin_of_any_finite_size_is_in_collision(margin: float, count: int) -> None:
    field = GaussianCollisionField(random_gaussians(count, np.random.default_rng(15), least=5e-3))
    arm = RobotSpheres(panda(), T_world_base=np.diag([1.0, 1.0, 1.0, 1.0]) + 30 * np.eye(4, k=3), margin=margin)
    assert arm.check(field, panda().home).in_collision.all()  # 1e20² is infinite in float32
    assert (arm.clearance(field, panda().home).distance < 0.0).all()


def test_quaternions_of_any_norm_are_directions() -> None:
    rng = np.random.default_rng(7)
    model = random_gaussians(100, rng)
    points = rng.uniform(-1, 1, (200, 3))
    expected = GaussianCollisionField(model).clearance(points).distance
    for norm in (1e-30, 1e-3, 1e15):
        scaled = model.clone()
        scaled.quats *= norm
        np.testing.assert_allclose(GaussianCollisionField(scaled).clearance(points).distance, expected, atol=1e-6)


def test_a_hundredth_of_damaged_gaussians_is_named_and_never_free() -> None:
    for column, value in (
        ("means", torch.nan),
        ("quats", 0.0),
        ("log_scales", torch.inf),
        ("opacity_logits", torch.nan),
    ):
        model = random_gaussians(1000, np.random.default_rng(8))
        getattr(model, column)[::100] = value
        with pytest.raises(InputError, match=column):
            GaussianCollisionField(model)


def test_a_hundred_thousand_coincident_gaussians_are_one() -> None:
    one = gaussians([0.1, 0.2, 0.3], (0.02, 0.01, 0.005), [[0.9, 0.1, 0.2, 0.3]])
    many = one.select(torch.zeros(100_000, dtype=torch.int64))
    rng = np.random.default_rng(9)
    points = rng.uniform(-0.5, 0.5, (50, 3))
    a, b = GaussianCollisionField(one), GaussianCollisionField(many)
    np.testing.assert_array_equal(b.clearance(points).distance, a.clearance(points).distance)
    assert (b.clearance(points).index == 0).all()
    assert (b.mahalanobis(points).index == 0).all()
    np.testing.assert_array_equal(
        b.in_collision(np.c_[points, np.full(50, 0.3)]), a.in_collision(np.c_[points, np.full(50, 0.3)])
    )


def test_denormal_and_zero_coordinates() -> None:
    model = gaussians([[1e-40, -1e-42, 0.0], [0.5, 0, 0]], 0.05)
    points = np.array([[0.0, 0, 0], [1e-310, 0, 0], [1e-40, 1e-40, 1e-40], [0.1, 1e-300, 0]])
    np.testing.assert_allclose(
        GaussianCollisionField(model).clearance(points).distance, [-0.1, -0.1, -0.1, 0.0], atol=2e-6
    )


@pytest.mark.parametrize("n_sigma", [1e-3, 0.1, 30.0, 1e3])
def test_shells_from_a_thousandth_to_a_thousand_sigmas(n_sigma: float) -> None:
    rng = np.random.default_rng(10)
    model = random_gaussians(50, rng, least=1e-3, most=0.02)
    points = rng.normal(size=(200, 3)) * (1 + 0.05 * n_sigma)
    _certified(GaussianCollisionField(model, n_sigma), model, points, n_sigma)


def test_near_tangents_are_decided_on_the_safe_side() -> None:
    rng = np.random.default_rng(11)
    model = gaussians([0, 0, 0], (0.05, 0.03, 0.001), [[0.5, -0.4, 0.3, 0.7]])
    field = GaussianCollisionField(model)
    answer = field.clearance(rng.normal(size=(2000, 3)))
    away = rng.uniform(0, 0.2, 2000)
    centers = answer.witness + answer.gradient * away[:, None]
    gap = signed_distances(*local(model, 2.0, centers))[:, 0]
    for offset in (-1e-6, 0.0, 1e-6):
        radii = np.maximum(gap + offset, 0)
        hit = field.in_collision(np.c_[centers, radii])
        assert hit[gap <= radii].all()
    apart = gap > 1e-4
    assert apart.mean() > 0.9
    assert not field.in_collision(np.c_[centers, np.maximum(gap - 1e-5, 0)])[apart].any()


def test_a_plate_of_a_tenth_of_a_millimetre_stops_a_swept_point() -> None:
    rng = np.random.default_rng(12)
    plate = gaussians(np.c_[rng.uniform(-0.3, 0.3, (3000, 2)), np.zeros(3000)], (0.02, 0.02, 2.5e-5))
    field = GaussianCollisionField(plate)
    start = np.c_[rng.uniform(-0.2, 0.2, (50, 2)), np.full(50, 0.3)]
    assert capsules_in_collision(field, start, start * [1, 1, -1], 0.0).all()
    assert not field.in_collision(start).any()


def test_rotating_map_and_points_changes_no_distance_by_more_than_its_error() -> None:
    rng = np.random.default_rng(13)
    model = random_gaussians(200, rng, least=5e-3)
    points = rng.uniform(-1, 1, (300, 3))
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5])
    before = GaussianCollisionField(model).clearance(points).distance
    after = GaussianCollisionField(moved(model, turn)).clearance(turn.apply(points)).distance
    np.testing.assert_allclose(after, before, atol=5e-6)


def test_no_number_of_threads_changes_an_answer() -> None:
    from splatbot._native import set_num_threads

    rng = np.random.default_rng(14)
    model = tabletop().gaussians(5000)
    points = rng.uniform(-0.5, 1, (3000, 3))
    q = panda().random(3000, rng)
    answers = []
    for threads in (1, 2, 3):
        set_num_threads(threads)
        field, arm = GaussianCollisionField(model), RobotSpheres(panda())
        answers.append((field.clearance(points).distance, field.native.grid_cells(), arm.check(field, q).link))
    set_num_threads(0)
    for other in answers[1:]:
        for a, b in zip(answers[0], other, strict=True):
            np.testing.assert_array_equal(a, b)

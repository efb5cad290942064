"""Euclidean clearance and hits of spheres, against closed forms, float64 bisection and Splat-Nav's separation test."""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from splatbot._native import available_isas, set_isa
from splatbot.collision import GaussianCollisionField
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from tests.unit.collision.oracle import Array, gaussians, local, random_gaussians, separation, signed_distances

UNDER, ROUNDED_UP = 4e-6, 1e-6  # of ClearanceResult: times |v|_1 + a, times the longest semi-axis


@pytest.fixture(params=available_isas())
def isa(request: pytest.FixtureRequest) -> Iterator[str]:
    """Each instruction set that this CPU runs."""
    set_isa(request.param)
    yield request.param
    set_isa("")


def _check_certified(found: Array, v: Array, a: Array) -> None:
    """Check that found (P,) is a lower bound of the least true distance (P, N) with the documented error."""
    truth = signed_distances(v, a)
    nearest = truth.argmin(axis=1)
    rows = np.arange(len(found))
    assert (found <= truth.min(axis=1)).all()
    bound = UNDER * (np.abs(v[rows, nearest]).sum(axis=-1) + a[nearest].min(axis=-1))
    assert (found >= truth.min(axis=1) - bound - ROUNDED_UP * a[nearest].max(axis=-1)).all()


@pytest.mark.parametrize("n", [1, 15, 16, 17, 300])
def test_distance_never_exceeds_the_true_one_and_is_close_to_it(n: int, isa: str) -> None:
    rng = np.random.default_rng(n)
    model = random_gaussians(n, rng)
    points = rng.uniform(-1.3, 1.3, (200, 3))
    _check_certified(GaussianCollisionField(model).clearance(points).distance, *local(model, 2.0, points))


@pytest.mark.parametrize(
    "axes", [(0.3, 0.2, 0.1), (0.2, 0.2, 1e-4), (0.5, 1e-4, 1e-4), (0.1, 0.1, 0.1), (5.0, 0.3, 1e-4)]
)
def test_points_inside_and_on_planes_of_symmetry_have_their_depth(axes: tuple[float, ...], isa: str) -> None:
    rng = np.random.default_rng(0)
    model = gaussians([0, 0, 0], np.array(axes) / 2)
    direction = rng.normal(size=(300, 3))
    direction /= np.linalg.norm(direction, axis=1, keepdims=True)
    points = direction * rng.uniform(0, 1, (300, 1)) * np.array(axes)
    points[:50, 0] = 0.0
    points[25:75, 1] = 0.0
    points[50:100, 2] = 0.0
    points[0] = 0.0
    answer = GaussianCollisionField(model).clearance(points)
    v, a = local(model, 2.0, points)
    assert (answer.distance <= 0).all()
    _check_certified(answer.distance, v, a)
    assert answer.distance[0] == pytest.approx(-min(axes), rel=1e-5)


def test_spheres_and_balls_of_radius_zero_have_the_closed_form() -> None:
    field = GaussianCollisionField(gaussians([0.0, 0, 0], 0.05))  # a ball of 0.1 m
    answer = field.clearance([[0.3, 0, 0, 0.05], [0, 0.3, 0, 0.0], [0, 0, -0.1, 0.02], [0, 0, 0.04, 0.0]])
    np.testing.assert_allclose(answer.distance, [0.15, 0.2, -0.02, -0.06], atol=3e-6)
    np.testing.assert_allclose(answer.gradient, [[1, 0, 0], [0, 1, 0], [0, 0, -1], [0, 0, 1]], atol=1e-6)
    np.testing.assert_allclose(answer.witness, [[0.1, 0, 0], [0, 0.1, 0], [0, 0, -0.1], [0, 0, 0.1]], atol=1e-6)
    np.testing.assert_array_equal(np.asarray(answer), answer.distance)


@cache
def _pairs() -> tuple[tuple[GaussianModel, Array, NDArray[np.bool_], Array], ...]:
    """Return 40 ellipsoids, each with spheres (2500, 4), whether they are apart, and their gaps [m]."""
    rng = np.random.default_rng(1)
    scales = np.exp(rng.uniform(np.log(1e-3), np.log(0.1), (40, 3)))
    model = gaussians(np.zeros((40, 3)), scales, rng.normal(size=(40, 4)))
    pairs = []
    for i in range(40):
        one = model.select(torch.tensor([i]))
        points = rng.normal(size=(2500, 3)) * scales[i].max() * 2.5
        radii = rng.uniform(0, 0.1, 2500)
        v, a = (x[..., 0, :] for x in np.broadcast_arrays(*local(one, 2.0, points)))
        apart = separation(v, a, np.maximum(radii, 1e-9)) > 1
        pairs.append((one, np.c_[points, radii], apart, signed_distances(v, a) - radii))
    return tuple(pairs)


def test_hits_equal_splat_navs_separation_and_are_never_unsafe(isa: str) -> None:
    unsafe = missed = 0
    for one, spheres, apart, gap in _pairs():  # one ellipsoid a field: every pair is decided by itself
        hit = GaussianCollisionField(one).in_collision(spheres)
        unsafe += int((~hit & ~apart).sum())
        missed += int((hit & apart & (gap > 1e-5)).sum())
    assert unsafe == 0
    assert missed == 0


def test_hits_say_what_clearance_says() -> None:
    rng = np.random.default_rng(2)
    model = random_gaussians(3000, rng, most=0.02)
    field = GaussianCollisionField(model)
    spheres = np.c_[rng.uniform(-1.1, 1.1, (5000, 3)), rng.uniform(0, 0.1, 5000)]
    distance = field.clearance(spheres).distance
    hit = field.in_collision(spheres)
    assert hit[distance <= 0].all()
    assert not hit[distance > 1e-5].any()
    assert 0.1 < hit.mean() < 0.9


def test_gradient_equals_finite_differences_away_from_ties() -> None:
    rng = np.random.default_rng(3)
    model = random_gaussians(500, rng, least=5e-3)
    field = GaussianCollisionField(model)
    points = rng.uniform(-1, 1, (400, 3))
    two = field.nearest(points, 2).distance
    points = points[(two[:, 1] - two[:, 0] > 4e-3) & (np.abs(two[:, 0]) > 5e-3)]
    assert len(points) > 100
    gradient, h = field.clearance(points).gradient, 1e-4
    differences = np.stack(
        [
            (field.clearance(points + h * e).distance - field.clearance(points - h * e).distance) / (2 * h)
            for e in np.eye(3)
        ],
        axis=-1,
    )
    assert np.abs(gradient - differences).max() < 1e-4


def test_witness_lies_on_the_ellipsoid_named_and_at_the_distance() -> None:
    rng = np.random.default_rng(4)
    model = random_gaussians(500, rng)
    points = rng.uniform(-1.2, 1.2, (300, 3))
    answer = GaussianCollisionField(model).clearance(points)
    v, a = local(model, 2.0, answer.witness)
    rows = np.arange(300)
    on = np.linalg.norm(v[rows, answer.index] / a[answer.index], axis=-1)
    np.testing.assert_allclose(on, 1.0, atol=1e-4)
    apart = np.linalg.norm(points - answer.witness, axis=-1) * np.sign(answer.distance)
    np.testing.assert_allclose(answer.distance, apart, atol=2e-5)
    offset = (points - answer.witness) / (apart[:, None] + 1e-12)
    np.testing.assert_allclose(answer.gradient[np.abs(apart) > 1e-3], offset[np.abs(apart) > 1e-3], atol=1e-3)


def test_the_k_nearest_are_the_first_of_all_distances() -> None:
    rng = np.random.default_rng(5)
    model = random_gaussians(200, rng)
    points = rng.uniform(-1, 1, (100, 3))
    answer = GaussianCollisionField(model).nearest(points, 7)
    truth = signed_distances(*local(model, 2.0, points))
    np.testing.assert_allclose(answer.distance, np.sort(truth, axis=1)[:, :7], atol=2e-5)
    np.testing.assert_allclose(truth[np.arange(100)[:, None], answer.index], answer.distance, atol=2e-5)
    few = GaussianCollisionField(model.select(torch.arange(3))).nearest(points, 7)
    assert (few.index[:, 3:] == -1).all()
    assert np.isinf(few.distance[:, 3:]).all()


def test_beyond_the_cut_there_is_no_answer_and_within_it_the_same() -> None:
    rng = np.random.default_rng(6)
    field = GaussianCollisionField(random_gaussians(100, rng))
    points = rng.uniform(-2, 2, (500, 3))
    whole, cut = field.clearance(points), field.clearance(points, cut=0.3)
    near = whole.distance <= 0.3 - 1e-4
    np.testing.assert_array_equal(cut.distance[near], whole.distance[near])
    far = whole.distance > 0.3 + 1e-4
    assert far.any()
    assert np.isinf(cut.distance[far]).all()
    assert (cut.index[far] == -1).all()
    assert np.isnan(cut.witness[far]).all()


def test_an_empty_map_is_free_everywhere() -> None:
    field = GaussianCollisionField(GaussianModel.empty())
    assert not field.in_collision([[0.0, 0, 0, 10.0]]).any()
    assert field.clearance([[0.0, 0, 0]]).distance[0] == np.inf
    assert field.nearest([[0.0, 0, 0]], 3).index.tolist() == [[-1, -1, -1]]


def test_the_grids_bound_never_exceeds_the_distance() -> None:
    rng = np.random.default_rng(7)
    model = random_gaussians(400, rng, most=0.02)
    field = GaussianCollisionField(model)
    points = rng.uniform(-1.4, 1.4, (100_000, 3))
    bound = field.native.grid_bounds(points)
    distance = np.maximum(field.clearance(points, cut=0.4).distance, 0)
    assert (bound <= distance).all()
    assert (bound > 0.02).mean() > 0.05
    tight = (distance > 0.08) & (distance < 0.3) & (bound > 0)
    assert (distance - bound)[tight].max() < 0.02 * 2 * np.sqrt(3) + 0.02


def test_the_grids_bound_holds_where_some_gaussians_lie_beyond_the_grid() -> None:
    rng = np.random.default_rng(8)
    model = random_gaussians(2000, rng, most=0.02)
    model.means[0] = torch.tensor([300.0, 0, 0])  # too far for a grid of fine voxels
    model.means[1:5] = torch.tensor([[1.45, 0, 0], [-1.5, 0.5, 0], [0, 1.6, 0.2], [0, 0, -1.7]])
    field = GaussianCollisionField(model)
    points = rng.uniform(-2, 2, (100_000, 3))
    bound = field.native.grid_bounds(points)
    assert (bound <= np.maximum(field.clearance(points, cut=0.4).distance, 0)).all()
    assert (bound > 0.05).any()
    assert 0 < field.native.voxel < 0.04


@pytest.mark.parametrize("radius", [-0.1, np.nan, 1e9])
def test_a_radius_that_makes_no_sense_is_named(radius: float) -> None:
    with pytest.raises(InputError, match=r"row 1|radius"):
        GaussianCollisionField(gaussians([0, 0, 0], 0.1)).in_collision([[0, 0, 0, 0.1], [0, 0, 0, radius]])


def test_a_cut_or_k_out_of_range_is_named() -> None:
    field = GaussianCollisionField(gaussians([0, 0, 0], 0.1))
    with pytest.raises(InputError, match="cut"):
        field.clearance([[0.0, 0, 0]], cut=-1.0)
    with pytest.raises(InputError, match="k: is 65"):
        field.nearest([[0.0, 0, 0]], 65)

"""The Mahalanobis field against float64 brute force and closed forms."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
import torch
from numpy.typing import NDArray
from scipy.spatial.distance import cdist
from scipy.spatial.transform import Rotation

from splatbot._native import CollisionField
from splatbot.collision import GaussianCollisionField
from splatbot.collision.field import SCALE_FLOOR
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel, Snapshot
from tests.unit.collision.oracle import gaussians as _model
from tests.unit.collision.oracle import moved

ERROR_BOUND = 1.5e-6  # of the class docstring: times L / least scale


def _random(n: int, rng: np.random.Generator, least: float = 1e-3, extent: float = 1.0) -> GaussianModel:
    scales = np.exp(rng.uniform(np.log(least), np.log(0.05), (n, 3)))
    return _model(rng.uniform(-extent, extent, (n, 3)), scales, rng.normal(size=(n, 4)), rng.uniform(0.1, 1, n))


def _oracle(model: GaussianModel, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Compute all distances (P, N) by scipy in float64, from the inverse covariance of the model's float32 values."""
    R = Rotation.from_quat(model.quats.double().numpy(), scalar_first=True).as_matrix()
    S = np.maximum(model.log_scales.double().exp().numpy(), SCALE_FLOOR)
    inverses = np.einsum("nij,nj,nkj->nik", R, S**-2, R)
    means = model.means.double().numpy()
    columns = [cdist(points, means[i : i + 1], "mahalanobis", VI=inverses[i]) for i in range(len(model))]
    return np.hstack(columns)


@pytest.mark.parametrize("n", [1, 15, 16, 17, 333])
def test_distance_and_index_agree_with_scipy_in_float64(n: int) -> None:
    rng = np.random.default_rng(n)
    model = _random(n, rng)
    points = rng.uniform(-1.2, 1.2, (101, 3))
    truth = _oracle(model, points)
    answer = GaussianCollisionField(model).mahalanobis(points)
    bound = ERROR_BOUND * 1.2 * np.sqrt(3) / float(model.scales.min())
    np.testing.assert_allclose(answer.distance, truth.min(axis=1), atol=bound, rtol=1e-6)
    # The index may differ from the oracle's only between Gaussians that float32 cannot distinguish.
    np.testing.assert_allclose(truth[np.arange(101), answer.index], truth.min(axis=1), atol=2 * bound, rtol=1e-6)
    assert (answer.index == truth.argmin(axis=1)).mean() > 0.98


def test_the_stated_error_bound_holds_near_flat_surfaces() -> None:
    rng = np.random.default_rng(7)
    n, s = 500, 1e-4
    model = _model(rng.uniform(-1, 1, (n, 3)), (0.02, 0.03, s), rng.normal(size=(n, 4)))
    R = Rotation.from_quat(model.quats.double().numpy(), scalar_first=True).as_matrix()
    offsets = np.stack([rng.normal(0, 0.02, n), rng.normal(0, 0.03, n), rng.uniform(-3, 3, n) * s], -1)
    points = model.means.double().numpy() + np.einsum("nij,nj->ni", R, offsets)
    answer = GaussianCollisionField(model).mahalanobis(points)
    off = np.abs(answer.distance - _oracle(model, points).min(axis=1))
    assert off.max() <= ERROR_BOUND * np.sqrt(3) * 1.1 / s


def test_a_point_on_a_centre_is_at_distance_zero() -> None:
    model = _random(64, np.random.default_rng(0))
    answer = GaussianCollisionField(model).mahalanobis(model.means)
    assert answer.distance.max() < 1e-3
    np.testing.assert_array_equal(answer.index, np.arange(64))


@pytest.mark.parametrize("thickness", [1e-12, 1e-6, SCALE_FLOOR])
def test_a_flat_gaussian_is_as_thick_as_the_floor_and_no_thinner(thickness: float) -> None:
    field = GaussianCollisionField(_model([0, 0, 0], (0.1, 0.1, thickness)))
    answer = field.mahalanobis([[0, 0, 3 * SCALE_FLOOR], [0.2, 0, 0], [0, 0, 1e-3]])
    np.testing.assert_allclose(answer.distance, [3.0, 2.0, 1e-3 / SCALE_FLOOR], rtol=1e-5)


def test_a_needle_is_long_along_its_axis_alone() -> None:
    half_turn = np.sqrt(0.5)
    needle = _model([0, 0, 0], (0.3, 1e-4, 1e-4), [[half_turn, 0, 0, half_turn]])  # the long axis turned to y
    answer = GaussianCollisionField(needle).mahalanobis([[0, 0.6, 0], [2e-4, 0, 0], [0.6, 0, 0]])
    np.testing.assert_allclose(answer.distance, [2.0, 2.0, 6000.0], rtol=1e-4)


def test_a_map_a_kilometre_from_the_origin_answers_as_well_as_one_around_it() -> None:
    rng = np.random.default_rng(3)
    near = _random(200, rng)
    shift = np.array([1000.0, -2000.0, 500.0])
    far = near.clone()
    far.means += torch.as_tensor(shift, dtype=torch.float32)
    points = far.means.double().numpy()[:100] + rng.normal(0, 0.01, (100, 3))
    answer = GaussianCollisionField(far).mahalanobis(points)
    bound = ERROR_BOUND * 2 / float(far.scales.min())
    np.testing.assert_allclose(answer.distance, _oracle(far, points).min(axis=1), atol=bound, rtol=1e-6)


def test_rotating_and_moving_map_and_points_together_changes_nothing() -> None:
    rng = np.random.default_rng(5)
    model = _random(100, rng, least=5e-3)
    points = rng.uniform(-1, 1, (50, 3))
    turn = Rotation.from_rotvec([0.3, -1.0, 0.5])
    before = GaussianCollisionField(model).mahalanobis(points)
    after = GaussianCollisionField(moved(model, turn, shift=3.0)).mahalanobis(turn.apply(points) + 3)
    np.testing.assert_allclose(after.distance, before.distance, rtol=1e-3)


def test_adding_gaussians_or_widening_the_shell_never_frees_a_point() -> None:
    rng = np.random.default_rng(11)
    model = _random(150, rng)
    points = rng.uniform(-1, 1, (2000, 3))
    few = GaussianCollisionField(model.select(torch.arange(100)), 2.0).in_collision(points)
    assert few.any()
    assert not few.all()
    assert GaussianCollisionField(model, 2.0).in_collision(points)[few].all()
    assert GaussianCollisionField(model.select(torch.arange(100)), 3.0).in_collision(points)[few].all()


def test_the_shell_itself_is_in_collision() -> None:
    field = GaussianCollisionField(_model([0, 0, 0], 0.25), n_sigma=2.0)
    np.testing.assert_array_equal(
        field.in_collision(np.array([[0.5, 0, 0], [0.501, 0, 0], [0, 0, 0]])), [True, False, True]
    )


def test_equal_gaussians_answer_with_the_lowest_index() -> None:
    field = GaussianCollisionField(_model(np.zeros((40, 3)), 0.1))
    np.testing.assert_array_equal(field.mahalanobis([[0.05, 0, 0]]).index, [0])


def test_faint_gaussians_are_air_and_indices_still_name_rows_of_the_model() -> None:
    model = _model([[0, 0, 0], [1, 0, 0], [2, 0, 0]], 0.1, opacities=[0.9, 0.2, 0.9])
    field = GaussianCollisionField(model, min_opacity=0.5)
    assert len(field) == 2
    np.testing.assert_array_equal(field.mahalanobis([[1.0, 0, 0], [2.0, 0, 0]]).index, [0, 2])
    assert GaussianCollisionField(model, min_opacity=0.0).in_collision([[1.0, 0, 0]]).all()


def test_a_guess_that_no_depth_supports_is_no_obstacle_until_it_is_observed() -> None:
    model = _model([[0, 0, 0], [1, 0, 0], [2, 0, 0]], 0.1)
    model.observations[1] = 0
    field = GaussianCollisionField(model)
    assert len(field) == 2
    np.testing.assert_array_equal(field.in_collision([[0.0, 0, 0], [1.0, 0, 0], [2.0, 0, 0]]), [True, False, True])
    np.testing.assert_array_equal(field.mahalanobis([[1.0, 0, 0], [1.9, 0, 0]]).index, [0, 2])
    model.observations[1] = 1
    assert GaussianCollisionField(model).in_collision([[1.0, 0, 0]]).all()


def test_a_map_of_guesses_alone_is_free_everywhere() -> None:
    model = _model([[0, 0, 0], [1, 0, 0]], 0.1)
    model.observations.zero_()
    answer = GaussianCollisionField(model).mahalanobis([[0.0, 0, 0]])
    assert answer.distance[0] == np.inf
    assert answer.index[0] == -1


def test_an_empty_map_is_free_everywhere() -> None:
    answer = GaussianCollisionField(GaussianModel.empty()).mahalanobis([[0.0, 0, 0]])
    assert answer.distance[0] == np.inf
    assert answer.index[0] == -1


def test_no_points_give_no_answers() -> None:
    assert GaussianCollisionField(_model([0, 0, 0], 0.1)).mahalanobis(np.empty((0, 3))).distance.shape == (0,)


def test_a_snapshot_names_its_version_and_later_changes_of_the_model_do_not_reach_the_field() -> None:
    model = _model([0, 0, 0], 0.1)
    field = GaussianCollisionField(Snapshot(model, map_version=7))
    model.means += 5.0
    answer = field.mahalanobis([[0.0, 0, 0]])
    assert answer.map_version == 7
    assert answer.distance[0] == 0.0


def test_numpy_and_torch_of_any_float_type_and_order_give_the_same_answer() -> None:
    rng = np.random.default_rng(2)
    field = GaussianCollisionField(_random(30, rng))
    points = rng.uniform(-1, 1, (20, 3)).astype(np.float32)
    expected = field.mahalanobis(points).distance
    same_points: list[Any] = [points.astype(np.float64), np.asfortranarray(points), torch.from_numpy(points)]
    for same in [*same_points, points.tolist()]:
        np.testing.assert_array_equal(field.mahalanobis(same).distance, expected)


@pytest.mark.parametrize(
    ("points", "message"),
    [
        ([[0.0, 0.0]], r"points: is \(1, 2\)"),
        ([0.0, 0.0, 0.0], r"points: is \(3,\)"),
        ([[0.0, 0, 0], [np.nan, 0, 0]], "points: row 1 is not finite"),
        ([[np.inf, 0, 0]], "points: row 0 is not finite"),
        ([[0.0, 0, 0], [0, 0, -2e9]], "points: row 1 is beyond 1e"),
        ([[1e300, 0, 0]], "points: row 0 is beyond 1e"),
    ],
)
def test_points_that_make_no_sense_are_named_instead_of_called_free(points: object, message: str) -> None:
    with pytest.raises(InputError, match=message):
        GaussianCollisionField(_model([0, 0, 0], 0.1)).in_collision(np.asarray(points, dtype=np.float64))


@pytest.mark.parametrize("column", ["means", "quats", "log_scales", "opacity_logits"])
def test_a_damaged_gaussian_is_named_instead_of_never_being_hit(column: str) -> None:
    model = _random(10, np.random.default_rng(0))
    getattr(model, column)[4] = torch.nan
    with pytest.raises(InputError, match=f"{column}: row 4 is not finite"):
        GaussianCollisionField(model)


def test_a_zero_quaternion_is_named() -> None:
    model = _random(10, np.random.default_rng(0))
    model.quats[3] = 0.0
    with pytest.raises(InputError, match="quats: row 3 is zero"):
        GaussianCollisionField(model)


@pytest.mark.parametrize("n_sigma", [0.0, -1.0, float("nan"), float("inf")])
def test_a_shell_without_extent_is_refused(n_sigma: float) -> None:
    with pytest.raises(InputError, match="n_sigma"):
        GaussianCollisionField(_model([0, 0, 0], 0.1), n_sigma)


def test_the_native_border_converts_nothing_silently() -> None:
    means, quats = np.zeros((1, 3), np.float32), np.array([[1, 0, 0, 0]], np.float32)
    names = np.zeros(1, np.int32)
    options = {"n_sigma": 2.0, "voxel": 0.0, "max_voxels": 1}
    field = CollisionField(means, quats, means + 1, names, **options)
    with pytest.raises(TypeError):
        field.mahalanobis(np.zeros((1, 3), np.float32))
    with pytest.raises(TypeError):
        field.mahalanobis(np.zeros((1, 6))[:, ::2])  # not contiguous
    with pytest.raises(TypeError):
        CollisionField(means.astype(np.float64), quats, means + 1, names, **options)
    with pytest.raises(ValueError, match="length"):
        field.hits(np.zeros((2, 3)), np.zeros(1, np.float32))
    with pytest.raises(ValueError, match="length"):
        CollisionField(np.zeros((2, 3), np.float32), quats, means + 1, names, **options)
    with pytest.raises(ValueError, match="negative"):
        CollisionField(means, quats, means + 1, names - 1, **options)


@pytest.mark.parametrize("far", [1e3, 1e6, 1e9])
def test_a_point_as_far_away_as_may_be_asked_has_its_distance(far: float) -> None:
    model = _model([[0.0, 0, 0]], [[0.01, 0.01, 0.01]])
    found = GaussianCollisionField(model).mahalanobis([[far, 0, 0], [0, -far, 0]])
    np.testing.assert_allclose(found.distance, far / 0.01, rtol=1e-5)
    assert (found.index == 0).all()

"""The Gaussians that training starts from."""

from __future__ import annotations

import numpy as np

from splatbot.training.images import ImageCache
from splatbot.training.initialize import initial_model, looked_at, neighbour_distances, random_points
from tests.unit.training.rendered import rendered_data, ring, true_model


def test_sizes_are_the_distance_to_the_three_nearest_points(rng: np.random.Generator) -> None:
    points = rng.normal(size=(60, 3))
    distances = np.sort(np.linalg.norm(points[:, None] - points[None], axis=2), axis=1)[:, 1:4]
    np.testing.assert_allclose(neighbour_distances(points), np.sqrt((distances**2).mean(axis=1)))


def test_few_and_equal_points_have_finite_sizes() -> None:
    assert np.isfinite(neighbour_distances(np.zeros((1, 3)))).all()
    assert (neighbour_distances(np.zeros((5, 3))) > 0).all()
    assert len(neighbour_distances(np.zeros((0, 3)))) == 0


def test_the_point_that_cameras_look_at_is_found_and_parallel_axes_are_finite() -> None:
    assert np.linalg.norm(looked_at(np.stack(ring(9)))) < 0.01
    assert np.isfinite(looked_at(np.stack([np.eye(4)] * 3))).all()


def test_random_points_lie_in_the_visual_hull() -> None:
    data = rendered_data(12)
    images = ImageCache(data.views)
    points = random_points(images, 500, np.random.default_rng(0))
    nearest = np.linalg.norm(points[:, None] - true_model().means.double().numpy()[None], axis=2).min(axis=1)
    assert len(points) == 500
    assert np.quantile(nearest, 0.95) < 0.35  # the cube reaches 1.4 m from the centre


def test_points_above_the_cap_are_thinned_and_keep_their_colours() -> None:
    data = rendered_data(3, points=400)
    model = initial_model(data, ImageCache(data.views), most=100, seed=0)
    assert len(model) == 100
    rows = np.linalg.norm(model.means.double().numpy()[:, None] - data.points[None], axis=2).argmin(axis=1)
    np.testing.assert_allclose(model.colors.numpy(), data.point_colors[rows] / 255, atol=1e-5)

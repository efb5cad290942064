"""The error of a map's surfaces, measured by its own depth images."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField, surface_error
from splatbot.errors import InputError
from tests.unit.collision.oracle import gaussians

CAMERA = Camera(60.0, 60.0, 39.5, 29.5, 80, 60)


def _wall(z: float) -> GaussianCollisionField:
    """Return balls of 5 mm, 3 mm apart, so that a plane at ``z`` is their ridge to 0.3 mm."""
    x, y = np.meshgrid(np.arange(-0.9, 0.9, 0.006), np.arange(-0.7, 0.7, 0.006))
    return GaussianCollisionField(gaussians(np.c_[x.ravel(), y.ravel(), np.full(x.size, z)], 0.005))


def test_the_error_of_a_wall_that_is_off_is_how_far_it_is_off() -> None:
    field = _wall(1.0)
    depth = np.full((60, 80), 0.97, np.float32)  # measured 3 cm before the ridge, 2 cm before the balls of 2 sigma
    error = surface_error(field, [(depth, CAMERA, np.eye(4))])
    assert error.share(0.5) == pytest.approx(0.020, abs=5e-4)
    assert error.share(1.0) == pytest.approx(0.020, abs=2e-3)
    inside = surface_error(field, [(np.full((60, 80), 1.0, np.float32), CAMERA, np.eye(4))])
    assert inside.share(1.0) == 0.0


def test_no_ball_that_the_margin_enlarges_is_called_free_where_it_reaches_into_what_was_measured() -> None:
    rng = np.random.default_rng(0)
    field = _wall(1.0)
    depth = rng.uniform(0.96, 1.02, (60, 80)).astype(np.float32)
    depth[rng.random((60, 80)) < 0.2] = 0.0
    margin = surface_error(field, [(depth, CAMERA, np.eye(4))]).share(1.0)
    v, u = np.nonzero(depth)
    z = depth[v, u].astype(np.float64)
    measured = np.c_[(u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z, z]
    radii = rng.uniform(1e-3, 0.05, len(z))
    direction = rng.normal(size=measured.shape)
    centers = measured + direction / np.linalg.norm(direction, axis=1, keepdims=True) * (0.999 * radii)[:, None]
    assert field.in_collision(np.c_[centers, radii + margin]).all()
    assert not field.in_collision(np.c_[centers, radii]).all()


def test_only_what_lies_around_a_place_counts_if_one_is_given() -> None:
    field = _wall(1.0)
    depth = np.full((60, 80), 1.0, np.float32)
    depth[:, 40:] = 0.9  # the right half has an error of 10 cm
    views = [(depth, CAMERA, np.eye(4))]
    assert surface_error(field, views).share(1.0) > 0.08
    assert surface_error(field, views, around=[-0.4, 0.0, 1.0, 0.3]).share(1.0) == 0.0
    with pytest.raises(InputError, match="no depth"):
        surface_error(field, views, around=[0.0, 0.0, 9.0, 0.3])


def test_views_without_depth_or_of_another_size_are_refused() -> None:
    field = _wall(1.0)
    with pytest.raises(InputError, match="no depth"):
        surface_error(field, [(np.zeros((60, 80), np.float32), CAMERA, np.eye(4))])
    with pytest.raises(InputError, match="depth: is"):
        surface_error(field, [(np.ones((6, 8), np.float32), CAMERA, np.eye(4))])
    with pytest.raises(InputError, match="share"):
        surface_error(field, [(np.ones((60, 80), np.float32), CAMERA, np.eye(4))]).share(99.9)

"""Normals that are fitted to depth: exact on planes, steady under noise, of one surface at its edge."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.mapping.normals import fitted_normals, smooth_normals
from tests.rgbd import CAMERA

ROWS, COLUMNS = (grid.ravel() for grid in np.mgrid[0 : CAMERA.height : 3, 0 : CAMERA.width : 3])


def plane(normal: NDArray[np.float64], distance: float) -> NDArray[np.float32]:
    """Compute the depth (H, W) [m] of the plane n · p = distance."""
    v, u = np.mgrid[0 : CAMERA.height, 0 : CAMERA.width]
    rays = np.stack([(u - CAMERA.cx) / CAMERA.fx, (v - CAMERA.cy) / CAMERA.fy, np.ones(u.shape)], -1)
    return (distance / (rays @ normal)).astype(np.float32)


def unit(*vector: float) -> NDArray[np.float64]:
    return np.array(vector) / np.linalg.norm(vector)


@pytest.mark.parametrize("normal", [unit(0, 0, 1), unit(0.5, -0.3, 0.9), unit(-0.5, 0.2, 0.85)])
def test_a_plane_has_its_normal_towards_the_camera_up_to_the_border(normal: NDArray[np.float64]) -> None:
    found = fitted_normals(plane(normal, 1.5), CAMERA, ROWS, COLUMNS, reach=6)
    np.testing.assert_allclose(found, np.broadcast_to(-normal, found.shape), atol=1e-4)


def test_noise_of_a_sensor_at_two_and_a_half_metres_turns_normals_by_some_degrees_only() -> None:
    noise = 0.01 * np.random.default_rng(0).standard_normal((CAMERA.height, CAMERA.width))
    normal = unit(0.3, 0.1, 1)
    found = fitted_normals((plane(normal, 2.5) + noise).astype(np.float32), CAMERA, ROWS, COLUMNS, reach=6)
    angle = np.degrees(np.arccos(np.clip(-found @ normal, -1, 1)))
    assert np.median(angle) < 4.0
    assert np.percentile(angle, 95) < 12.0


def test_at_a_step_each_side_keeps_its_own_normal() -> None:
    depth = plane(unit(0.4, 0, 1), 1.2)
    depth[:, CAMERA.width // 2 :] = plane(unit(0, 0.4, 1), 2.0)[:, CAMERA.width // 2 :]
    found = fitted_normals(depth, CAMERA, ROWS, COLUMNS, reach=6)
    left = np.less(COLUMNS, CAMERA.width // 2)
    np.testing.assert_allclose(found[left], np.broadcast_to(-unit(0.4, 0, 1), found[left].shape), atol=1e-4)
    np.testing.assert_allclose(found[~left], np.broadcast_to(-unit(0, 0.4, 1), found[~left].shape), atol=1e-4)


def test_one_wild_sample_does_not_turn_a_normal() -> None:
    depth = plane(unit(0, 0, 1), 1.0)
    depth[32, 40] += 0.04
    found = fitted_normals(depth, CAMERA, np.array([30]), np.array([40]), reach=6)
    np.testing.assert_allclose(found, [[0, 0, -1]], atol=1e-4)


def test_too_few_samples_or_samples_in_one_line_have_no_normal() -> None:
    full = plane(unit(0, 0, 1), 1.0)
    dot, line = np.zeros_like(full), np.zeros_like(full)
    dot[30, 40] = 1.0
    line[30] = full[30]
    for depth in (dot, line):
        assert (fitted_normals(depth, CAMERA, np.array([30]), np.array([40]), reach=6) == 0).all()
    assert fitted_normals(full, CAMERA, np.zeros(0, np.int64), np.zeros(0, np.int64), reach=6).shape == (0, 3)


def test_smooth_normals_are_those_of_the_fit_to_all_pixels_and_none_at_a_step() -> None:
    normal = unit(0.4, 0.1, 1)
    depth = plane(normal, 1.2)
    depth[:, CAMERA.width // 2 :] += 0.5
    rows, columns = np.meshgrid(*map(np.arange, depth.shape), indexing="ij")
    found = smooth_normals(depth, CAMERA, rows, columns, 4)
    middle = CAMERA.width // 2
    np.testing.assert_allclose(found[:, 10 : middle - 4], np.broadcast_to(-normal, (120, middle - 14, 3)), atol=1e-4)
    assert (found[:, middle - 4 : middle + 4] == 0).all()
    depth[50:60] = 0
    assert (smooth_normals(depth, CAMERA, rows, columns, 4)[52:58] == 0).all()

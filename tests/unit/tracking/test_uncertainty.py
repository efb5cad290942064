"""Covariances of poses: calibrated for known noise, composed like random errors, and always finite."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import ArrayLike

from splatbot.config import SensorConfig, TrackingConfig
from splatbot.geometry import inverse, se3_exp, se3_log
from splatbot.tracking.align import Alignment, align
from splatbot.tracking.prepare import Level, prepare
from splatbot.tracking.reference import make_reference
from splatbot.tracking.uncertainty import CalibratedView, Uncertainty, alignment_covariance, world_uncertainty
from tests.rgbd import CAMERA, Array, rays_of, tabletop, wall_depth, wall_frame

CONFIG = TrackingConfig(n_pixels=2000)
GATE = CONFIG.sensor.max_depth_difference


def corner_levels(T_world_camera: Array, rng: np.random.Generator, gray_noise: float, depth_noise: float) -> Level:
    """Render textured walls that form a corner, with white noise."""
    depths = [wall_depth(CAMERA, T_world_camera, n, d) for n, d in (((0.5, 0, 1), 1.2), ((-0.5, 0.4, 1), 1.2))]
    z = np.minimum(*depths) + depth_noise * rng.standard_normal((120, 160))
    exact = np.minimum(*depths)
    points = (rays_of(CAMERA) * exact[..., None]) @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
    x, y, w = np.moveaxis(points, -1, 0)
    gray = 0.5 + 0.15 * np.sin(31 * x + 9 * w) + 0.15 * np.sin(27 * y - 8 * x)
    gray = gray + gray_noise * rng.standard_normal(gray.shape)
    return Level(gray.astype(np.float32), z.astype(np.float32), CAMERA)


def test_the_spread_of_the_residuals_measures_the_error_for_any_noise_model() -> None:
    """White noise of other strengths than configured: C⁻¹ S C⁻¹ alone has a NEES / 6 near 1."""
    # The noise of the pixels is the only one.
    config = TrackingConfig(n_pixels=2000, sensor=SensorConfig(depth_sigma_scale=1.0))
    rng, T = np.random.default_rng(1), se3_exp([0.004, -0.003, 0.005, 0.004, -0.003, 0.002])
    for gray_noise, depth_noise in ((0.01, 0.002), (0.04, 0.0005)):
        values = []
        for _ in range(40):
            reference = make_reference((corner_levels(np.eye(4), rng, 0.0, 0.0),), np.eye(4), CONFIG.n_pixels)
            level = corner_levels(T, rng, gray_noise, depth_noise)
            found = align([level], [reference], T, config, photometric=True, finest=0, gate=GATE)
            C = np.linalg.inv(found.curvature)
            off = se3_log(inverse(found.T_world_camera) @ T)
            robust = C @ found.spread @ C * found.cells / (found.cells - 6)
            values.append(off @ np.linalg.solve(robust, off) / 6)
            assert off @ np.linalg.solve(alignment_covariance(found), off) / 6 < values[-1]
        assert 0.5 < np.mean(values) < 2.5


def test_the_covariance_is_symmetric_positive_and_grows_as_pixels_go() -> None:
    frames, poses = tabletop()
    levels = prepare(frames[1], CONFIG).levels
    sizes = []
    for n in (4000, 1000, 250):
        reference = make_reference(prepare(frames[0], CONFIG).levels, poses[0], n)
        found = align(levels, [reference], poses[1], CONFIG, photometric=True, finest=0, gate=GATE)
        covariance = alignment_covariance(found)
        np.testing.assert_array_equal(covariance, covariance.T)
        assert np.linalg.eigvalsh(covariance)[0] > 0
        sizes.append(np.trace(covariance[:3, :3]))
    assert sizes[0] < sizes[1] < sizes[2]


def test_without_any_information_the_covariance_is_large_and_finite_and_of_nan_it_is_nan() -> None:
    nothing = Alignment(np.eye(4), np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6)), 0, 525.0)
    covariance = alignment_covariance(nothing)
    assert np.linalg.eigvalsh(covariance)[0] >= 100.0
    assert np.isfinite(covariance).all()
    assert np.isnan(alignment_covariance(replace(nothing, information=np.full((6, 6), np.nan)))).all()


@pytest.mark.parametrize(("cells", "share"), [(0, 1.0), (4, 1.0), (6, 1.0), (12, 0.25), (48, 1 / 64)])
def test_the_noise_model_counts_in_full_where_cells_are_too_few_to_tell(cells: int, share: float) -> None:
    H = np.diag([1e6, 2e6, 4e6, 1e6, 2e6, 4e6])
    agreed = Alignment(np.eye(4), H, H, np.zeros((6, 6)), cells, 525.0)  # no cell pulls anywhere
    covariance = alignment_covariance(agreed)
    np.testing.assert_allclose(np.diag(covariance)[:3], share / np.diag(H)[:3], rtol=1e-6)
    assert (np.diag(covariance)[3:] > share / np.diag(H)[3:]).all()  # nor can an image be placed without error


def test_a_blank_wall_is_not_known_along_itself() -> None:
    wall = prepare(wall_frame(np.eye(4), textured=False), CONFIG)
    reference = make_reference(wall.levels, np.eye(4), 1000)
    found = align(wall.levels, [reference], np.eye(4), CONFIG, photometric=True, finest=0, gate=GATE)
    deviations = np.sqrt(np.diag(alignment_covariance(found)))
    assert deviations[2] < 5e-3
    assert deviations[:2].min() > 1.0


def test_errors_of_a_keyframe_are_carried_to_the_poses_found_with_it() -> None:
    """Against 20,000 random errors of both, composed as transforms."""
    rng = np.random.default_rng(2)
    T_world_keyframe = se3_exp([0.5, -0.2, 0.3, 0.2, 0.6, -0.1])
    T_world_camera = T_world_keyframe @ se3_exp([0.3, 0.1, -0.2, 0.1, -0.4, 0.2])
    A, B = rng.standard_normal((2, 6, 6)) * 1e-3
    carried = world_uncertainty(T_world_camera, B @ B.T, [(T_world_keyframe, Uncertainty(A @ A.T))])
    T_keyframe_camera = inverse(T_world_keyframe) @ T_world_camera
    samples = [
        se3_log(
            inverse(T_world_camera)
            @ T_world_keyframe
            @ se3_exp(A @ rng.standard_normal(6))
            @ T_keyframe_camera
            @ se3_exp(B @ rng.standard_normal(6))
        )
        for _ in range(20_000)
    ]
    np.testing.assert_allclose(carried.random, np.cov(np.array(samples).T), atol=4e-7)


def test_two_keyframes_with_one_error_do_not_average_it_out() -> None:
    known = Uncertainty(np.diag([1e-6] * 3 + [1e-8] * 3), moved=1.0, turned=2.0)
    one = world_uncertainty(np.eye(4), np.zeros((6, 6)), [(np.eye(4), known)])
    two = world_uncertainty(np.eye(4), np.zeros((6, 6)), [(np.eye(4), known)] * 2)
    np.testing.assert_allclose(two.random, one.random, rtol=1e-12)
    assert two.moved == pytest.approx(1.0)


def test_the_covariance_grows_with_the_length_of_the_chain() -> None:
    step, known, T = se3_exp([0.1, 0, 0, 0, 0.1, 0]), Uncertainty(), np.eye(4)
    sizes = []
    for _ in range(10):
        before, T = T, T @ step
        known = world_uncertainty(T, np.diag([1e-6] * 6), [(before, known)])
        sizes.append(np.trace(known.covariance(view())[:3, :3]))
    assert (np.diff(sizes) > 0).all()
    assert known.moved == pytest.approx(10 * np.linalg.norm(step[:3, 3]))
    assert known.turned == pytest.approx(1.0)


def view(twist: ArrayLike = (0.0,) * 6, **sensor: float) -> CalibratedView:
    """Return a view at 2 m with a focal length of 500 px, and no error of calibration but those of ``sensor``."""
    exact = {"stamp_sigma": 0.0, "image_sigma": 0.0, "calibration_error": 0.0}
    return CalibratedView(SensorConfig(**(exact | sensor)), np.asarray(twist, np.float64), 2.0, 500.0)


def test_a_wrong_stamp_is_an_error_along_the_motion() -> None:
    """Against 20,000 poses of the same motion at random times."""
    twist, rng = np.array([0.3, -0.1, 0.2, 0.5, 1.0, -0.4]), np.random.default_rng(3)
    errors = np.array([se3_log(se3_exp(dt * twist)) for dt in rng.normal(0, 0.01, 20_000)])
    found = Uncertainty().covariance(view(twist, stamp_sigma=0.01))
    np.testing.assert_allclose(found, np.cov(errors.T), atol=0.03 * found.max())


def test_a_displaced_image_is_an_error_of_position_or_of_rotation() -> None:
    """A point at 2 m moves by a pixel if the camera moves by the standard deviation or turns by it."""
    moved, *_, turned = np.sqrt(np.diag(Uncertainty().covariance(view(image_sigma=1.0))))
    point = np.array([0.0, 0.0, 2.0, 1.0])
    for twist in ([moved, 0, 0, 0, 0, 0], [0, 0, 0, 0, turned, 0]):
        x, _, z, _ = inverse(se3_exp(twist)) @ point
        assert abs(500 * x / z) == pytest.approx(1.0, rel=1e-5)


def test_a_wrong_focal_length_accumulates_along_the_path() -> None:
    known = Uncertainty(moved=2.0, turned=0.5)
    deviations = np.sqrt(np.diag(known.covariance(view(calibration_error=0.01))))
    np.testing.assert_allclose(deviations, [0.02 / np.sqrt(3)] * 3 + [0.005 / np.sqrt(3)] * 3)

"""Rectification: against exact poses of each row, against images of one instant, and with the worst input."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatbot import _native
from splatbot.camera import Camera
from splatbot.config import Config, SensorConfig
from splatbot.frame import Frame
from splatbot.geometry import inverse, se3_exp, se3_log, transform_points
from splatbot.logs.synthetic import SyntheticLog
from splatbot.tracking.rectify import RectifiedLog, moved_pixels, rectify, row_displacement, twist_at
from splatbot.trajectory import Trajectory

CAMERA = Camera(130.0, 131.0, 79.0, 60.0, 160, 120)
TWIST = np.array([0.3, -0.2, 0.1, 0.8, 1.9, -0.7])  # 2.2 rad/s = 125 °/s
READOUT = 0.03
ROLLING = SensorConfig(readout=READOUT)
INTRINSICS = (CAMERA.fx, CAMERA.fy, CAMERA.cx, CAMERA.cy)


def frame_of(depth: np.ndarray) -> Frame:
    """Return a frame of random colours."""
    rgb = np.random.default_rng(0).integers(0, 255, (120, 160, 3), np.uint8)
    return Frame(0.5, rgb, depth.astype(np.float32), CAMERA)


def test_a_frame_that_nothing_displaces_is_returned_itself() -> None:
    frame = frame_of(np.full((120, 160), 1.5))
    assert rectify(frame, TWIST, SensorConfig()) is frame
    assert rectify(frame, np.zeros(6), ROLLING) is frame


def test_each_pixel_is_found_where_its_row_sees_it() -> None:
    """The exact place is the root of a scalar equation in the row, with the exponential map of scipy's precision."""
    depth = np.full((120, 160), 1.5, np.float32)
    at = np.asarray(_native.rectify_map(depth, INTRINSICS, TWIST.tolist(), READOUT, 0.0))
    for u, v in [(5, 3), (80, 60), (150, 110), (20, 100)]:
        point = CAMERA.backproject(depth)[v, u].astype(np.float64)
        low, high = v - 40.0, v + 40.0
        for _ in range(60):
            row = 0.5 * (low + high)
            seconds = (row / 119 - 0.5) * READOUT
            pixel = CAMERA.project(transform_points(inverse(se3_exp(seconds * TWIST)), point))
            low, high = (row, high) if pixel[1] > row else (low, row)
        assert at[v, u] == pytest.approx(pixel, abs=0.02)


def test_depth_becomes_that_of_the_stamp() -> None:
    """A plane in general position: depth along each ray of the stamp has a closed form."""
    normal, distance = np.array([0.2, -0.1, 1.0]), 1.6

    def plane(T_now_then: np.ndarray, rays: np.ndarray) -> np.ndarray:
        R, t = T_now_then[:3, :3], T_now_then[:3, 3]
        return (distance - normal @ t) / (rays @ (R.T @ normal))

    rays = CAMERA.backproject(np.ones((120, 160), np.float32)).astype(np.float64)
    rows = [plane(se3_exp((v / 119 - 0.5) * READOUT * TWIST), rays[v]) for v in range(120)]
    found = np.asarray(
        _native.rectify_depth(np.array(rows, np.float32), INTRINSICS, TWIST.tolist(), READOUT, 0.0, np.eye(4))
    )
    inner = (slice(10, -10), slice(10, -10))  # at the border, depth is that of the nearest pixel
    np.testing.assert_allclose(found[inner], plane(np.eye(4), rays)[inner], atol=2e-4)


def test_a_rotation_of_the_depth_camera_shifts_its_image() -> None:
    depth = np.where(np.arange(160) < 80, 1.0, 2.0).astype(np.float32) * np.ones((120, 1), np.float32)
    sensor = SensorConfig(depth_to_color=(0, 0, 0, 0, 4 / CAMERA.fx, 0), depth_scale=1.01, depth_bias=0.02)
    found = rectify(frame_of(depth), TWIST, sensor).depth
    assert found[60, 82] == pytest.approx(1.03, abs=2e-3)
    assert found[60, 86] == pytest.approx(2.04, abs=2e-2)
    assert (found[:, :3] == 0).all()  # nothing is seen there


def test_a_rolling_shutter_frame_becomes_that_of_a_global_shutter() -> None:
    uri = "synthetic:room?trajectory=turns&frames=10&width=320&height=240"
    ideal, rolling = SyntheticLog(uri), SyntheticLog(f"{uri}&effects=rolling_shutter:readout=0.03")
    rectified = RectifiedLog(rolling, Config(sensor=ROLLING), {"": ideal.ground_truth})
    exact, read, found = ideal[7], rolling[7], rectified[7]
    inner = (slice(20, -20), slice(20, -20))
    before, after = (np.abs(f.rgb[inner].astype(float) - exact.rgb[inner]).mean() for f in (read, found))
    assert after < 0.15 * before
    before, after = (np.median(np.abs(f.depth - exact.depth)[inner]) for f in (read, found))
    assert after < 0.1 * before


@pytest.mark.parametrize("depth", [0.0, 1e-6, 1e6])
@pytest.mark.parametrize("speed", [1e-9, 1.0, 1e3])
def test_any_depth_and_any_speed_give_finite_images(depth: float, speed: float) -> None:
    frame = frame_of(np.full((120, 160), depth))
    found = rectify(frame, speed * np.ones(6), SensorConfig(readout=0.1, depth_delay=0.05))
    assert np.isfinite(found.depth).all()
    assert found.mask is not None
    assert not (found.depth[~found.mask] > 0).any()


def test_matches_move_with_the_twist() -> None:
    points = np.array([[0.3, 0.4, 1.5], [-0.5, -0.4, 2.0]])
    at_row = CAMERA.project(points)
    change = 0.05 * TWIST
    seconds = (at_row[:, 1] / 119 - 0.5) * READOUT
    exact = [CAMERA.project(transform_points(se3_exp(s * change), p)) for s, p in zip(seconds, points, strict=True)]
    np.testing.assert_allclose(moved_pixels(at_row, points, CAMERA, change, READOUT), exact, atol=0.01)
    largest = np.linalg.norm(np.array(exact) - at_row, axis=1).max()
    assert largest < 1.5 * row_displacement(change, 1.5, CAMERA, READOUT)


def test_the_twist_of_a_trajectory_is_the_mean_of_both_sides_and_zero_beyond_a_gap() -> None:
    stamps = np.array([0.0, 0.1, 0.2, 1.0])
    path = Trajectory(stamps, np.array([se3_exp(t * TWIST) for t in stamps]))
    for stamp in (0.0, 0.05, 0.1):
        np.testing.assert_allclose(twist_at(path, stamp), TWIST, atol=1e-9)
    assert not twist_at(path, 0.6).any()
    assert not twist_at(Trajectory(stamps[:1], path.T_world_camera[:1]), 0.0).any()
    assert se3_log(path.T_world_camera[1]) == pytest.approx(0.1 * TWIST)


def test_a_delay_of_the_stamps_counts_as_one_of_the_sensor_and_is_gone_afterwards() -> None:
    frame = frame_of(np.random.default_rng(1).uniform(1.0, 2.0, (120, 160)))
    stamped = rectify(replace(frame, depth_delay=0.012), TWIST, SensorConfig(readout=READOUT, depth_delay=-0.002))
    by_sensor = rectify(frame, TWIST, SensorConfig(readout=READOUT, depth_delay=0.010))
    np.testing.assert_array_equal(stamped.depth, by_sensor.depth)
    assert stamped.depth_delay == 0.0
    assert rectify(stamped, TWIST, SensorConfig()) is stamped

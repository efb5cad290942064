"""Time offsets: recovered between clocks with different zeros, refused for unrelated motions."""

from __future__ import annotations

import zipfile
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline

from splatbot.calibration.hand_eye import calibrate_hand_eye
from splatbot.calibration.link_motion import PoseLinkMotion
from splatbot.calibration.streams import align_streams
from splatbot.calibration.time_offset import cross_correlate
from splatbot.errors import InputError
from splatbot.formats.trajectory import load_trajectory
from splatbot.geometry import se3_exp
from splatbot.trajectory import Trajectory

Array = NDArray[np.float64]


def motion(times: Array, seed: int = 0, *, knot: float = 0.7) -> Array:
    """Return poses (N, 4, 4) of a smooth motion that does not repeat within 70 s; ``knot`` [s] is its pace."""
    knots = np.arange(-2.0, 72.0, knot)
    twists = CubicSpline(knots, np.random.default_rng(seed).normal(0, 0.4, (len(knots), 6)))(times)
    return np.stack([se3_exp(xi) for xi in twists])


@pytest.mark.parametrize(("delay", "epoch"), [(0.0, 0.0), (0.137, 0.0), (-2.5, 0.0), (0.0213, 1.5e9), (-40.0, 1e6)])
def test_the_delay_of_two_frames_of_one_body_is_recovered_to_two_milliseconds(delay: float, epoch: float) -> None:
    X, Y = se3_exp([0.1, 0.2, -0.1, 0.5, 1.0, -0.3]), se3_exp([1.0, 0, 2.0, -1.0, 0.2, 0.4])
    a, b = np.arange(0, 40, 0.01), np.arange(3.0, 33.0, 1 / 30)
    T_b = Y @ motion(b) @ X
    rng = np.random.default_rng(1)
    T_b = np.array([T @ se3_exp(rng.normal(0, 0.002, 6)) for T in T_b])
    found = cross_correlate(epoch + a + delay, motion(a), b, T_b)
    assert found - epoch == pytest.approx(delay, abs=0.002)


def test_noisy_poses_of_a_slow_motion_give_the_delay_to_two_milliseconds() -> None:
    a, b = np.arange(0, 40, 0.01), np.arange(3.0, 33.0, 1 / 30)
    errors = []
    for seed in range(6):
        rng = np.random.default_rng(seed + 10)
        noisy = np.array([T @ se3_exp(rng.normal(0, 0.01, 6)) for T in motion(b, seed, knot=2.0)])
        errors.append(cross_correlate(a + 0.0213, motion(a, seed, knot=2.0), b, noisy) - 0.0213)
    assert np.sqrt(np.mean(np.square(errors))) < 0.002  # 4 ms with speeds over 0.1 s alone


def test_motions_that_are_unrelated_or_at_rest_are_refused() -> None:
    t = np.arange(0, 30, 0.02)
    rest = np.tile(np.eye(4), (len(t), 1, 1))
    for other in (motion(t, 2), motion(t, 3), rest):
        with pytest.raises(InputError, match="do not agree"):
            cross_correlate(t, motion(t, 0), t, other)


def test_a_motion_that_repeats_leaves_a_doubt_that_is_named() -> None:
    t = np.arange(0, 40, 0.02)
    cycle = motion(t % 4.0, 3)
    with pytest.raises(InputError, match="the motion repeats") as caught:
        cross_correlate(t, cycle, t[500:1500], cycle[500:1500])
    assert "--same-clock" in str(caught.value.hint)


def test_rest_before_and_after_the_motion_does_not_hide_the_delay() -> None:
    t = np.arange(0, 60, 0.02)
    moving = np.clip(t, 20, 40)
    rng = np.random.default_rng(0)
    a, b = (np.array([T @ se3_exp(rng.normal(0, 1e-4, 6)) for T in motion(moving)]) for _ in range(2))
    assert cross_correlate(t + 0.3, a, t, b) == pytest.approx(0.3, abs=0.003)


def test_short_and_endless_recordings_are_refused() -> None:
    t = np.arange(0, 30, 0.02)
    with pytest.raises(InputError, match="has 5 poses"):
        cross_correlate(t, motion(t), t[:5], motion(t[:5]))
    with pytest.raises(InputError, match="lasts"):
        cross_correlate(t * 1e6, motion(t), t, motion(t))


@pytest.mark.parametrize(
    ("name", "arm", "camera"),
    [
        ("robot_arm_w_color_camera_sim", "robot_arm_sim_hand", "robot_arm_sim_camera"),
        ("robot_arm_w_color_camera_real", "sr300_hinge", "target_ir"),
        ("prime_sense_color_w_vicon_1", "vicon_prime_sense", "W_camera_rgb_image_raw"),
        ("3_falcon", "22-23_falcon_vicon", "22-23_imu_odom"),
    ],
)
def test_least_squares_and_cross_correlation_agree_to_five_milliseconds_on_recordings(
    data_root: Path, tmp_path: Path, name: str, arm: str, camera: str
) -> None:
    with zipfile.ZipFile(data_root / "hand_eye_time_offset" / f"{name}.zip") as archive:
        archive.extractall(tmp_path)
    (arm_file,) = (p for p in tmp_path.rglob(f"*{arm}.csv") if "merged_" not in p.name)
    (camera_file,) = (p for p in tmp_path.rglob(f"*{camera}.csv") if "merged_" not in p.name)
    tracked, record = (load_trajectory(path, unordered=True) for path in (camera_file, arm_file))
    moved, measured, start = align_streams(tracked, PoseLinkMotion(record.T_world_camera, record.stamps))
    assert start is not None
    found = calibrate_hand_eye(moved, measured, delay=start)
    assert found.delay is not None
    assert found.delay.value == pytest.approx(start, abs=0.005)


def test_slow_recordings_are_matched_by_equal_stamps_alone() -> None:
    t = np.arange(20.0)
    tracked = Trajectory(t[2:15], motion(t[2:15]))
    moved, measured, delay = align_streams(tracked, PoseLinkMotion(motion(t), t))
    assert delay is None
    assert len(moved) == len(measured.T_static_moving) == 13
    with pytest.raises(InputError, match="do not overlap"):
        align_streams(Trajectory(t + 0.5, motion(t)), PoseLinkMotion(motion(t), t))

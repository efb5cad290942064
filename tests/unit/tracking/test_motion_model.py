"""Prediction: exact for a constant twist, at rest whenever the velocity is not to be believed."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.linalg import expm

from splatbot.geometry import skew, so3_exp
from splatbot.tracking.gyroscope import MeasuredTurn, Trust
from splatbot.tracking.motion_model import CONSTANTS, ConstantVelocity

TWIST = np.array([0.3, -0.2, 0.5, 0.4, 0.1, -0.6])  # per second: (m, rad)
START = np.array([[0.0, -1.0, 0.0, 1.0], [1.0, 0.0, 0.0, -2.0], [0.0, 0.0, 1.0, 0.5], [0.0, 0.0, 0.0, 1.0]])


def pose(stamp: float) -> np.ndarray:
    """Compute the pose of a camera of constant body twist by the matrix exponential."""
    M = np.zeros((4, 4))
    M[:3, :3], M[:3, 3] = skew(TWIST[3:]), TWIST[:3]
    return np.asarray(START @ expm(M * stamp))


def updated(*stamps: float) -> ConstantVelocity:
    motion = ConstantVelocity()
    for stamp in stamps:
        motion.update(stamp, pose(stamp))
    return motion


@pytest.mark.parametrize("stamps", [(0.0, 0.1, 0.2), (0.0, 0.1, 0.25), (5.0, 5.3, 5.31), (0.0, 0.02, 0.08)])
def test_a_constant_twist_is_continued_exactly_at_even_and_uneven_stamps(stamps: tuple[float, float, float]) -> None:
    *known, next_stamp = stamps
    np.testing.assert_allclose(updated(*known).predict(next_stamp), pose(next_stamp), atol=1e-12)


def test_without_a_pose_the_origin_is_predicted_and_with_one_pose_rest() -> None:
    motion = ConstantVelocity()
    np.testing.assert_array_equal(motion.predict(3.0), np.eye(4))
    motion.update(3.0, START)
    np.testing.assert_array_equal(motion.predict(4.0), START)


def test_after_a_lost_frame_the_camera_is_expected_where_it_was_last_seen() -> None:
    motion = updated(0.0, 0.1)
    motion.forget_velocity()
    np.testing.assert_array_equal(motion.predict(0.3), pose(0.1))


def test_the_first_pose_after_a_lost_frame_gives_the_velocity_back() -> None:
    motion = updated(0.0, 0.1)
    motion.forget_velocity()
    motion.update(0.3, pose(0.3))
    np.testing.assert_allclose(motion.predict(0.4), pose(0.4), atol=1e-12)


def test_a_long_gap_forgets_the_velocity_and_a_short_one_does_not() -> None:
    motion = updated(0.0, 0.1)
    np.testing.assert_allclose(motion.predict(0.1 + 0.29), pose(0.39), atol=1e-12)
    np.testing.assert_array_equal(motion.predict(0.1 + 0.31), pose(0.1))


@pytest.mark.parametrize("stamps", [(1.0, 1.0), (2.0, 1.0)])
def test_stamps_that_do_not_increase_predict_rest(stamps: tuple[float, float]) -> None:
    motion = updated(*stamps)
    for stamp in (0.5, *stamps, 3.0):
        np.testing.assert_array_equal(motion.predict(stamp), pose(stamps[1]))


def test_a_stamp_that_repeats_predicts_the_same_pose() -> None:
    np.testing.assert_array_equal(updated(0.0, 0.1).predict(0.1), pose(0.1))


@pytest.mark.parametrize("trust", ["new", "proven", "doubted"])
def test_a_gyroscope_gives_the_rotation_also_of_lost_frames_unless_it_is_doubted(trust: Trust) -> None:
    R, covariance = so3_exp([0.3, -0.4, 0.2]), np.diag(np.repeat([1e-4, 1e-2], 3))
    turn = MeasuredTurn(R, np.zeros(3), covariance, np.zeros((3, 3)), 0.2, trust)
    motion = updated(0.0, 0.1)
    motion.forget_velocity()
    found, plain = motion.motion_prior(0.3, np.zeros((6, 6)), turn), motion.motion_prior(0.3, np.zeros((6, 6)))
    np.testing.assert_array_equal(found.covariance[:3, :3], plain.covariance[:3, :3])
    np.testing.assert_array_equal(found.T_world_camera[:3, 3], pose(0.1)[:3, 3])
    expected = pose(0.1)[:3, :3] @ (np.eye(3) if trust == "doubted" else R)
    np.testing.assert_allclose(found.T_world_camera[:3, :3], expected, atol=1e-12)
    variance = plain.covariance[3, 3] if trust == "doubted" else 1e-4 + CONSTANTS.rest**2
    np.testing.assert_allclose(found.covariance[3:, 3:], variance * np.eye(3), atol=1e-12)

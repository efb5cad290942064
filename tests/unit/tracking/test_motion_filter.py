"""Motion of the camera: the textbook filter, unknown velocities, rows, and noise that it removes."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.geometry import inverse, se3_exp, se3_log, so3_exp
from splatbot.tracking.align import Alignment
from splatbot.tracking.gyroscope import MeasuredTurn
from splatbot.tracking.motion_filter import CONSTANTS, CameraMotion, MotionFilter, mean_twist

TURN = np.array([0.0, 0.0, 0.0, 0.0, 1.0, 0.0])
WEAK = 1e8 * np.eye(6)  # covariance of a pose that says nothing


def aligned(T: np.ndarray, H: np.ndarray | None = None, g: np.ndarray | None = None) -> Alignment:
    zero, bands = np.zeros((6, 6)), np.zeros((0, 6, 6))
    return Alignment(T, zero, zero, zero, 48, 500.0, bands if H is None else H, np.zeros((0, 6)) if g is None else g)


def filtered(times: np.ndarray, poses: list[np.ndarray], covariance: np.ndarray) -> list[CameraMotion]:
    states = [CameraMotion.at_pose(times[0], poses[0], covariance)]
    for stamp, T in zip(times[1:], poses[1:], strict=True):
        states.append(states[-1].predict(stamp).measure(aligned(T), covariance, np.zeros(6), 0.0))
    return states


def test_along_one_axis_it_is_the_textbook_filter_of_position_and_velocity() -> None:
    """Oracle: the Kalman filter of a scalar position and velocity under white noise of acceleration."""
    rng, times, sigma = np.random.default_rng(0), np.cumsum([0.0, 0.03, 0.04, 0.033, 0.05, 0.03]), 0.004
    z = 0.2 * times + sigma * rng.normal(size=len(times))
    states = filtered(times, [se3_exp([x, 0, 0, 0, 0, 0]) for x in z], sigma**2 * np.eye(6))
    S = CONSTANTS.correlation * CONSTANTS.acceleration**2
    x, P = np.array([z[0], 0.0]), np.diag([sigma**2, CONSTANTS.speed**2])
    for k, dt in enumerate(np.diff(times), 1):
        F = np.array([[1.0, dt], [0.0, 1.0]])
        x, P = F @ x, F @ P @ F.T + S * np.array([[dt**3 / 3, dt**2 / 2], [dt**2 / 2, dt]])
        K = P[:, 0] / (P[0, 0] + sigma**2)
        x, P = x + K * (z[k] - x[0]), P - np.outer(K, P[0])
        np.testing.assert_allclose([states[k].T_world_camera[0, 3], states[k].twist[0]], x, rtol=1e-6)
        np.testing.assert_allclose(states[k].covariance[np.ix_([0, 6], [0, 6])], P, rtol=1e-6, atol=1e-11)


def test_exact_poses_are_kept_at_any_motion() -> None:
    rng = np.random.default_rng(1)
    poses = [np.eye(4)]
    for _ in range(20):  # jumps of 8 cm and 5°
        poses.append(poses[-1] @ se3_exp(np.r_[0.05 * rng.normal(size=3), 0.05 * rng.normal(size=3)]))
    times = np.arange(21) / 30
    for state, T in zip(filtered(times, poses, 1e-10 * np.eye(6)), poses, strict=True):
        assert np.abs(se3_log(inverse(state.T_world_camera) @ T)).max() < 2e-5


def test_a_jerk_displaces_a_pose_of_8_mm_by_10_mm_and_a_pose_of_half_a_millimetre_by_less_than_its_noise() -> None:
    """5 m/s² for 0.1 s at 30 Hz, from rest, without noise: docs/guide/tracking.md states the displacement."""
    times = np.arange(30) / 30
    pushed = np.clip(times - 0.5, 0, 0.1)
    x = 2.5 * pushed**2 + 5 * 0.1 * np.maximum(times - 0.6, 0)
    lags = {}
    for sigma in (0.0005, 0.008):
        states = filtered(times, [se3_exp([d, 0, 0, 0, 0, 0]) for d in x], sigma**2 * np.eye(6))
        lags[sigma] = max(abs(s.T_world_camera[0, 3] - d) for s, d in zip(states, x, strict=True))
    assert lags[0.0005] < 0.0005
    assert 0.008 < lags[0.008] < 0.0105


def test_noise_beyond_the_acceleration_of_a_hand_is_removed_and_the_covariance_is_honest() -> None:
    """A camera that turns at 60°/s with 8 mm and 0.3° of noise at 30 Hz: two thirds of the noise are left at most."""
    rng, n = np.random.default_rng(2), 300
    sigma = np.repeat([0.008, np.radians(0.3)], 3)
    times, twist = np.arange(n) / 30, np.array([0.1, 0.0, 0.05, 0.0, np.radians(60), 0.0])
    true = [se3_exp(t * twist) for t in times]
    states = filtered(times, [T @ se3_exp(sigma * rng.normal(size=6)) for T in true], np.diag(sigma**2))
    errors = np.array([se3_log(inverse(s.T_world_camera) @ T) for s, T in zip(states, true, strict=True)])[20:]
    assert np.sqrt((errors[:, :3] ** 2).mean()) < 2 / 3 * 0.008
    assert np.sqrt((errors[:, 3:] ** 2).mean()) < np.radians(0.3)
    nees = [e @ np.linalg.solve(s.covariance[:6, :6], e) / 6 for e, s in zip(errors, states[20:], strict=True)]
    assert np.mean(nees) < 1.5  # the motion is smoother than the model: less than 1 is expected


def test_the_rows_of_a_frame_reveal_its_velocity() -> None:
    """Linear residuals -J (ξ + s η) of 6 bands, with an unknown pose: the least-squares solution is the true η."""
    rng, readout = np.random.default_rng(0), 0.03
    used, true, pose = rng.normal(size=6), rng.normal(size=6), 1e-4 * rng.normal(size=6)
    s = ((np.arange(6) + 0.5) / 6 - 0.5) * readout
    J = 1e3 * rng.normal(size=(6, 40, 6))
    residual = np.einsum("bij,bj->bi", J, pose + s[:, None] * (true - used))
    H = np.einsum("bki,bkj->bij", J, J)
    total = H.sum(0)
    offset = np.linalg.solve(total, np.einsum("bki,bk->i", J, residual))  # the alignment ends where Σ g_b = 0
    g = np.einsum("bki,bk->bi", J, residual - J @ offset)
    start = CameraMotion(0.0, np.eye(4), np.zeros(6), np.diag(np.repeat([1.0, 1e6], 6)))
    found = start.measure(aligned(se3_exp(offset), H, g), np.linalg.inv(total), used, readout)
    np.testing.assert_allclose(found.twist, true, atol=1e-3)


def test_a_short_readout_measures_as_none() -> None:
    """The pose keeps its own covariance, which has another shape than the rows' information."""
    rng = np.random.default_rng(3)
    J = rng.normal(size=(6, 40, 6)) * [3000, 3000, 100, 10, 10, 500]
    H = np.einsum("bki,bkj->bij", J, J)
    covariance, pose = 1e-6 * np.eye(6), se3_exp([0.01, 0.01, 0.01, 0.0, 0.01, 0.0])
    predicted = CameraMotion.at_pose(0.0, np.eye(4), 1e-5 * np.eye(6))
    without, short = (predicted.measure(aligned(pose, H, np.zeros((6, 6))), covariance, TURN, r) for r in (0.0, 1e-9))
    np.testing.assert_allclose(short.T_world_camera, without.T_world_camera, atol=1e-7)
    np.testing.assert_allclose(short.covariance[:6, :6], without.covariance[:6, :6], rtol=1e-4, atol=1e-12)


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_rows_that_are_not_finite_leave_the_pose(value: float) -> None:
    start = CameraMotion.at_pose(0.0, np.eye(4), np.eye(6))
    pose = se3_exp([0.01, 0.02, 0.0, 0.0, 0.0, 0.1])
    found = start.measure(aligned(pose, np.full((6, 6, 6), value), np.zeros((6, 6))), 1e-12 * np.eye(6), TURN, 0.03)
    np.testing.assert_allclose(found.T_world_camera, pose, atol=1e-6)
    assert np.isfinite(found.covariance).all()


def test_a_pose_without_information_leaves_the_motion() -> None:
    state = CameraMotion.at_pose(0.0, np.eye(4), 1e-6 * np.eye(6), TURN)
    found = state.predict(0.03).measure(aligned(se3_exp(np.ones(6))), WEAK, np.zeros(6), 0.0)
    np.testing.assert_allclose(found.T_world_camera, se3_exp(0.03 * TURN), atol=1e-6)


def test_the_velocity_is_unknown_at_the_start_after_a_gap_and_when_forgotten() -> None:
    motion = MotionFilter()
    assert motion.predict(0.0) is None
    assert not motion.twist_at(0.0).any()
    motion.update(CameraMotion.at_pose(0.0, np.eye(4), np.zeros((6, 6)), TURN))
    for stamp in (-0.002, 0.0, 0.03):  # a carried camera has the stamp of the first one
        np.testing.assert_allclose(motion.twist_at(stamp), TURN)
    assert motion.predict(0.0) is None
    assert motion.predict(1.0) is None
    motion.forget()
    assert motion.predict(0.03) is None


def test_a_correction_of_the_map_moves_the_pose_and_keeps_the_velocity() -> None:
    motion, T = MotionFilter(), se3_exp([1.0, 2.0, 3.0, 0.1, 0.2, 0.3])
    motion.update(CameraMotion.at_pose(0.0, np.eye(4), np.zeros((6, 6)), TURN))
    motion.move(T)
    state = motion.predict(0.05)
    assert state is not None
    np.testing.assert_allclose(state.T_world_camera, T @ se3_exp(0.05 * TURN), atol=1e-12)
    np.testing.assert_allclose(state.twist, TURN, atol=1e-12)


def test_a_mean_velocity_needs_a_short_time() -> None:
    np.testing.assert_allclose(mean_twist(se3_exp(0.05 * TURN), 0.05), TURN, atol=1e-12)
    assert not mean_twist(se3_exp(TURN), 1.0).any()
    assert not mean_twist(se3_exp(TURN), 0.0).any()


def test_a_rotation_of_the_gyroscope_replaces_that_of_the_velocity_with_its_errors() -> None:
    """Oracle: 800 true motions with errors of the stated covariances; the errors of the prediction have its own."""
    rng, dt, R = np.random.default_rng(5), 0.03, so3_exp([0.1, -0.2, 0.05])
    P = np.diag(np.repeat([0.005, 0.004, 0.2, 1.0], 3) ** 2)
    mix = 1e-3 * rng.normal(size=(6, 6)) * np.repeat([1.0, 30.0], 3)[:, None]
    turn = MeasuredTurn(R, np.array([3.0, -6.0, 2.0]), mix @ mix.T, -dt * np.eye(3), dt)
    start = CameraMotion(1.0, se3_exp([0.3, 0.1, -0.2, 0.5, 0.2, 1.0]), np.array([0.4, -0.2, 0.1, 9, 9, 9]), P)
    predicted = start.predict_turn(1.0 + dt, turn)
    np.testing.assert_allclose(predicted.T_world_camera[:3, :3], start.T_world_camera[:3, :3] @ R, atol=1e-12)
    np.testing.assert_array_equal(predicted.twist, [0.4, -0.2, 0.1, 3, -6, 2])
    errors = []
    for x, e in zip(
        rng.multivariate_normal(np.zeros(12), P, 800),
        rng.multivariate_normal(np.zeros(6), turn.covariance, 800),
        strict=True,
    ):
        motion = np.r_[dt * (start.twist[:3] + x[6:9]), se3_log(_rotation(R @ so3_exp(e[:3])))[3:]]
        true = start.T_world_camera @ se3_exp(x[:6]) @ se3_exp(motion)
        errors.append(np.r_[se3_log(inverse(predicted.T_world_camera) @ true), x[6:9], e[3:]])
    whitened = np.linalg.solve(np.linalg.cholesky(predicted.covariance), np.array(errors).T)
    np.testing.assert_allclose(np.cov(whitened), np.eye(12), atol=0.25)


def _rotation(R: np.ndarray) -> np.ndarray:
    T = np.eye(4)
    T[:3, :3] = R
    return T

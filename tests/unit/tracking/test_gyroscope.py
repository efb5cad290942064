"""Gyroscope: preintegration against gtsam, honest covariances, the bias, and samples that make no sense."""

from __future__ import annotations

import logging
from itertools import pairwise

import gtsam
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from splatbot.geometry import so3_exp, so3_log
from splatbot.imu import ImuSamples
from splatbot.tracking.gyroscope import CONSTANTS, Gyroscope, MeasuredTurn, integrate

Array = NDArray[np.float64]

P_BIAS = CONSTANTS.bias**2 * np.eye(3)
NOISE = 1e-6 * np.eye(3)  # covariance [rad²] of a tracked rotation


def rows(rate: float = 200.0, until: float = 0.05, start: float = -0.02) -> Array:
    """Return samples of a rotation about changing axes, at up to 3 rad/s."""
    t = np.arange(np.ceil(start * rate), np.floor(until * rate) + 1) / rate
    return np.column_stack([t, 3 * np.sin(9 * t), 2 * np.cos(7 * t), 1.5 * np.sin(20 * t + 1)])


def turn_of(samples: Array, interval: tuple[float, float] = (0.0, 0.05), bias: Array | None = None) -> MeasuredTurn:
    found = integrate(samples, interval, np.zeros(3) if bias is None else bias, P_BIAS)
    assert found is not None
    return found


def test_a_rotation_and_its_derivative_by_the_bias_are_those_of_gtsam() -> None:
    samples, bias = rows(), np.array([0.02, -0.01, 0.03])
    found = turn_of(samples, bias=bias)
    oracle = gtsam.PreintegratedRotation(gtsam.PreintegratedRotationParams())
    inside = samples[(samples[:, 0] >= 0.0) & (samples[:, 0] <= 0.05 + 1e-12)]
    for before, after in pairwise(inside):
        oracle.integrateGyroMeasurement(0.5 * (before[1:] + after[1:]), bias, after[0] - before[0])
    np.testing.assert_allclose(found.R_last_camera, oracle.deltaRij().matrix(), atol=1e-12)
    np.testing.assert_allclose(found.bias_jacobian, oracle.delRdelBiasOmega(), atol=2e-6)


def test_a_finely_sampled_rotation_is_the_solution_of_its_differential_equation() -> None:
    """Oracle: scipy's product of 100,000 steps of a closed-form rate."""
    t = (np.arange(100_000) + 0.5) * 0.05 / 100_000
    rate = np.column_stack([3 * np.sin(9 * t), 2 * np.cos(7 * t), 1.5 * np.sin(20 * t + 1)])
    total = Rotation.identity()
    for part in np.split(rate, 1000):  # the mean of 100 steps of 0.5 µs each turns by 1e-4 rad
        total = total * Rotation.from_rotvec(part.mean(axis=0) * 0.05 / 1000)
    for hertz, bound in ((100.0, 2e-3), (200.0, 5e-4), (1000.0, 2e-5)):
        error = so3_log(total.as_matrix().T @ turn_of(rows(hertz)).R_last_camera)
        assert np.linalg.norm(error) < bound


def test_stated_errors_are_those_of_noise_bias_and_scale() -> None:
    """200 sensors with errors of the stated size: rotation and rate have a mean squared Mahalanobis distance of 1."""
    rng, true, errors = np.random.default_rng(0), turn_of(rows()), []
    for _ in range(200):
        samples = rows()
        samples[:, 1:] *= 1 + CONSTANTS.scale * rng.normal(size=3)
        samples[:, 1:] += CONSTANTS.bias * rng.normal(size=3) + CONSTANTS.noise * np.sqrt(200) * rng.normal(
            size=(len(samples), 3)
        )
        found = turn_of(samples)
        error = np.r_[so3_log(found.R_last_camera.T @ true.R_last_camera), true.rate - found.rate]
        errors.append(error @ np.linalg.solve(found.covariance, error) / 6)
    assert 0.2 < np.mean(errors) < 1.2


def test_the_bias_is_found_and_its_stated_error_is_honest() -> None:
    rng, true = np.random.default_rng(1), np.array([0.05, -0.03, 0.02])
    gyroscope, sigma = Gyroscope(), 5e-4
    for k in range(60):
        t = k / 30
        samples = rows(until=t + 1 / 30, start=t)
        samples[:, 1:] += true + 1e-4 * rng.normal(size=(len(samples), 3))
        exact = turn_of(rows(until=t + 1 / 30 + 0.01, start=t - 0.01), (t, t + 1 / 30)).R_last_camera
        turn = gyroscope.measure(ImuSamples.of(samples), t, t + 1 / 30)
        assert turn is not None
        gyroscope.observe(turn, exact @ so3_exp(sigma * rng.normal(size=3)), 2 * sigma**2 * np.eye(3))
    error = gyroscope.bias - true
    assert np.linalg.norm(error) < 0.01
    assert error @ np.linalg.solve(gyroscope.bias_covariance, error) < CONSTANTS.gate


@pytest.mark.parametrize(
    "samples",
    [
        np.zeros((0, 4)),
        rows()[::8],  # 25 Hz
        rows()[(rows()[:, 0] < 0.01) | (rows()[:, 0] > 0.045)],  # a gap in the middle
        rows(until=0.015),  # nothing before the frame
        rows(start=0.035),  # nothing after the last frame
        rows() + np.array([5.0, 0, 0, 0]),  # another clock
        np.minimum(3 * rows(), [np.inf, np.inf, 4.36, np.inf]),  # the range of 250 °/s is exceeded
        np.column_stack([np.linspace(0, 0.05, 5000), np.zeros((5000, 3))]),
        rows() * [1, 1e200, 1, 1],
    ],
    ids=["none", "slow", "gap", "late", "early", "clock", "saturated", "many", "absurd"],
)
def test_samples_that_do_not_determine_the_rotation_give_none(samples: Array) -> None:
    assert Gyroscope().measure(ImuSamples.of(samples), 0.0, 0.05) is None


def test_samples_in_any_order_with_nan_and_repeats_give_the_rotation_of_the_good_ones() -> None:
    good = rows()
    bad = np.concatenate([good[::-1], good[3:5] + np.array([0, 9, 9, 9]), [[0.031, np.nan, 0, 0], [np.inf, 0, 0, 0]]])
    found = Gyroscope().measure(ImuSamples.of(bad), 0.0, 0.05)
    assert found is not None
    assert np.array_equal(found.R_last_camera, turn_of(good).R_last_camera)


def test_samples_of_lost_frames_and_late_samples_are_kept_for_a_second() -> None:
    gyroscope, whole = Gyroscope(), rows(until=0.9)
    for k in range(1, 10):  # the frames up to 0.9 s are lost; each batch is 10 ms late
        part = whole[(whole[:, 0] > 0.1 * (k - 1) - 0.01 - (k == 1)) & (whole[:, 0] <= 0.1 * k - 0.01)]
        found = gyroscope.measure(ImuSamples.of(part), 0.0, 0.1 * k)
        assert found is not None
        expected = turn_of(whole, (0.0, 0.1 * k)).R_last_camera
        assert np.linalg.norm(so3_log(expected.T @ found.R_last_camera)) < 5e-3  # the rate of the last 10 ms is held
    assert gyroscope.measure(None, 0.0, 1.1) is None


def test_wrong_axes_are_doubted_with_one_warning_and_right_ones_are_trusted_again(
    caplog: pytest.LogCaptureFixture,
) -> None:
    gyroscope, doubted = Gyroscope(), []
    with caplog.at_level(logging.WARNING):
        for k in range(80):
            t, right = k / 30, k >= 20
            samples = rows(until=t + 1 / 30, start=t)
            exact = turn_of(samples, (t, t + 1 / 30)).R_last_camera
            given = samples if right else samples[:, [0, 2, 3, 1]]
            turn = gyroscope.measure(ImuSamples.of(given), t, t + 1 / 30)
            assert turn is not None
            doubted.append(turn.is_doubted)
            gyroscope.observe(turn, exact, NOISE)
    assert not doubted[0]
    assert all(doubted[8:20])
    assert not doubted[-1]
    assert caplog.text.count("contradicts the tracked rotation") == 1


def test_a_camera_at_rest_does_not_restore_the_trust() -> None:
    gyroscope = Gyroscope()
    for k in range(100):
        t, still = k / 30, k >= 20
        samples = rows(until=t + 1 / 30, start=t) * [1, *([0.0 if still else 1.0] * 3)]
        exact = turn_of(samples, (t, t + 1 / 30)).R_last_camera
        turn = gyroscope.measure(ImuSamples.of(samples[:, [0, 2, 3, 1]]), t, t + 1 / 30)
        assert turn is not None
        gyroscope.observe(turn, exact, NOISE)
        assert k < 20 or turn.is_doubted

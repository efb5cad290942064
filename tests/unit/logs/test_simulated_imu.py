"""The simulated IMU: rates and forces of closed-form motions, its stated errors, and frames that share all samples."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.errors import LogError
from splatbot.geometry import Array, so3_exp
from splatbot.logs import open_log
from splatbot.logs.simulated_imu import CONSTANTS, SimulatedImu, ideal_imu

SMALL = "synthetic:tabletop?width=16&height=16&trajectory=turns"
AXIS = np.array([0.6, 0.0, 0.8])


def circle(t: float) -> Array:
    """Return the pose of a camera that turns about a skew axis of its own at 2 rad/s, on a circle of 1 m at 3 rad/s."""
    T = np.eye(4)
    T[:3, :3] = so3_exp(2 * t * AXIS)
    T[:3, 3] = [np.cos(3 * t), np.sin(3 * t), 0.0]
    return T


@pytest.mark.parametrize("t", [0.0, 0.7])
def test_rate_and_force_are_those_of_a_closed_form_motion(t: float) -> None:
    """The acceleration of the circle is 9 m/s² to its centre; at rest the force is 9.81 m/s² upwards."""
    expected = so3_exp(2 * t * AXIS).T @ [-9 * np.cos(3 * t), -9 * np.sin(3 * t), 9.81]
    found = ideal_imu(circle, t)
    np.testing.assert_allclose(found[:3], 2 * AXIS, atol=1e-9)
    np.testing.assert_allclose(found[3:], expected, atol=1e-5)


def test_its_errors_are_the_stated_ones() -> None:
    biases = []
    for seed in range(40):
        sensor = SimulatedImu(lambda _: np.eye(4), 400.0, seed)
        errors = sensor.samples(-1.0, 0.25).angular_rate
        biases.append(sensor.gyro_bias)
        assert errors.std(axis=0).mean() == pytest.approx(CONSTANTS.gyro_noise * np.sqrt(400), rel=0.2)
        assert np.abs(errors.mean(axis=0) - sensor.gyro_bias).max() < 5 * CONSTANTS.gyro_noise * np.sqrt(400 / 100)
    assert np.std(biases) == pytest.approx(CONSTANTS.gyro_bias, rel=0.25)


def test_frames_share_all_samples_also_those_of_dropped_frames() -> None:
    log = open_log(f"{SMALL}&frames=20&imu=200&effects=frame_drops:rate=0.4")
    assert len(log) < 20
    frames = list(log)
    stamps = np.concatenate([frame.imu.gyro_stamps for frame in frames if frame.imu is not None])
    last = frames[-1].stamp
    np.testing.assert_allclose(stamps, np.arange(int(200 * last + 1e-9) + 1)[-len(stamps) :] / 200, atol=1e-12)
    assert all(frame.imu is not None and frame.imu.gyro_stamps[-1] <= frame.stamp for frame in frames)
    again = open_log(log.uri)[5].imu
    assert again is not None
    np.testing.assert_array_equal(again.gyroscope, frames[5].imu.gyroscope)  # type: ignore[union-attr]


def test_without_the_option_there_is_no_imu_and_a_wrong_rate_is_named() -> None:
    assert open_log(f"{SMALL}&frames=1")[0].imu is None
    with pytest.raises(LogError, match="imu"):
        open_log(f"{SMALL}&imu=-1")

"""Tracking of fast turns under a rolling shutter with the simulated gyroscope: right, wrong and missing samples."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import replace
from functools import cache

import numpy as np
import pytest

from splatbot import Slam
from splatbot.config import Config
from splatbot.geometry import inverse, se3_log
from splatbot.imu import ImuSamples
from splatbot.logs import open_log
from tests.rgbd import small_config

FAST = "synthetic:tabletop?width=160&height=120&trajectory=snaps&frames=40&imu=200&effects=rolling_shutter:readout=0.03"

Change = Callable[[ImuSamples], ImuSamples | None]


def config() -> Config:
    return small_config(sensor__readout=0.03)


def run(uri: str, change: Change, frames: int) -> tuple[Slam, np.ndarray]:
    """Return a run and its errors (N, 2): translation [m] and rotation [rad] of each tracked frame."""
    log, slam, errors = open_log(uri), Slam(config()), []
    truth = log.ground_truth
    assert truth is not None
    for k in range(frames):
        frame = log[k]
        assert frame.imu is not None
        T = slam.process(replace(frame, imu=change(frame.imu))).T_world_camera
        assert T is not None
        true = inverse(truth.T_world_camera[0]) @ truth.T_world_camera[k]
        error = se3_log(inverse(true) @ T)
        errors.append((np.linalg.norm(error[:3]), np.linalg.norm(error[3:])))
    return slam, np.array(errors)


@cache
def rms_without() -> np.ndarray:
    return np.sqrt((run(FAST, lambda _: None, 40)[1] ** 2).mean(axis=0))


@pytest.mark.parametrize(
    "samples", [ImuSamples.of(), ImuSamples.of([[np.nan, 1, 2, 3]]), ImuSamples.of([[-9.0, 1, 2, 3]])]
)
def test_frames_without_usable_samples_are_tracked_bit_for_bit_as_without_an_imu(samples: ImuSamples) -> None:
    uri = "synthetic:tabletop?width=80&height=60&trajectory=turns&frames=4&imu=200"
    with_imu, without = run(uri, lambda _: samples, 4)[0], run(uri, lambda _: None, 4)[0]
    for a, b in zip(with_imu.results, without.results, strict=True):
        assert np.array_equal(a.T_world_camera, b.T_world_camera)  # type: ignore[arg-type]
        assert np.array_equal(a.covariance, b.covariance)  # type: ignore[arg-type]


@pytest.mark.long
def test_turns_that_the_velocity_does_not_predict_are_tracked_more_exactly_with_the_gyroscope() -> None:
    """25° within 0.2 s, up to 63 rad/s²: the rate of the gyroscope rectifies the rows of the rolling shutter."""
    slam, errors = run(FAST, lambda imu: imu, 40)
    rms = np.sqrt((errors**2).mean(axis=0))
    assert (rms < 0.85 * rms_without()).all()
    true = np.array([-0.00164103, 0.0026698, 0.00217974])  # of seed 0
    gyroscope = slam._tracker._gyroscope
    error = gyroscope.bias - true
    assert error @ np.linalg.solve(gyroscope.bias_covariance, error) < 21.1  # 99.99 % of χ²
    assert slam._tracker._gyroscope._trust == "proven"


@pytest.mark.long
@pytest.mark.parametrize(
    "change",
    [
        lambda s: ImuSamples(s.gyro_stamps, s.angular_rate[:, [1, 2, 0]], s.accel_stamps, s.specific_force),
        lambda s: ImuSamples(s.gyro_stamps, -s.angular_rate, s.accel_stamps, s.specific_force),
        lambda s: ImuSamples(s.gyro_stamps, 0 * s.angular_rate, s.accel_stamps, s.specific_force),
        lambda s: s.shifted(0.05),
    ],
    ids=["axes", "sign", "dead", "clock"],
)
def test_a_wrong_gyroscope_costs_less_than_a_tenth_and_warns_once_at_most(
    change: Change, caplog: pytest.LogCaptureFixture
) -> None:
    with caplog.at_level(logging.WARNING):
        _, errors = run(FAST, change, 40)
    assert (np.sqrt((errors**2).mean(axis=0)) < 1.1 * rms_without()).all()
    assert caplog.text.count("contradicts the tracked rotation") <= 1

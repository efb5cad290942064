"""Simulated inertial sensor on the path of a synthetic camera."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.geometry import Array, so3_log
from splatbot.imu import ImuSamples
from splatbot.logs.trajectories import Path

GRAVITY = np.array([0.0, 0.0, 9.81])  # [m/s²] specific force of a camera at rest; z is up


@dataclass(frozen=True)
class SimulatedImuConstants:
    """Errors of the simulated sensor, those of a BMI270 by its data sheet."""

    gyro_noise: float = 1.2e-4
    """White noise [rad/s/√Hz]."""
    gyro_bias: float = 0.009
    """Standard deviation [rad/s] of the constant bias of each axis."""
    accel_noise: float = 1.6e-3
    """White noise [m/s²/√Hz]."""
    accel_bias: float = 0.2
    """Standard deviation [m/s²] of the constant bias of each axis."""
    step: float = 5e-4
    """Step [s] of the differences that give rate and acceleration of the path."""


CONSTANTS = SimulatedImuConstants()


class SimulatedImu:
    """A simulated gyroscope and accelerometer in the axes of the camera, with white noise and a constant bias.

    Args:
        path: T_world_camera (4, 4) at a time [s]; z is up.
        rate: samples a second [Hz].
        seed: seed of noise and bias.
    """

    def __init__(self, path: Path, rate: float, seed: int) -> None:
        self._path, self._rate, self._seed = path, rate, seed
        rng = np.random.default_rng([seed, 20])
        self.gyro_bias: Array = CONSTANTS.gyro_bias * rng.normal(size=3)
        self.accel_bias: Array = CONSTANTS.accel_bias * rng.normal(size=3)

    def samples(self, after: float, until: float) -> ImuSamples:
        """Return the samples with ``after < stamp <= until`` [s]; the first sample of the log is at 0 s.

        The noise follows from the seed and the first sample, so that equal arguments give equal samples.
        """
        first = max(int(np.floor(after * self._rate)) + 1, 0)
        stamps = np.arange(first, int(np.floor(until * self._rate)) + 1) / self._rate
        rng = np.random.default_rng([self._seed, 21, first])
        noise = rng.normal(size=(len(stamps), 6)) * np.sqrt(self._rate)
        ideal = np.array([ideal_imu(self._path, t) for t in stamps.tolist()]).reshape(-1, 6)
        rates = ideal[:, :3] + self.gyro_bias + CONSTANTS.gyro_noise * noise[:, :3]
        return ImuSamples(stamps, rates, stamps, ideal[:, 3:] + self.accel_bias + CONSTANTS.accel_noise * noise[:, 3:])


def ideal_imu(path: Path, stamp: float) -> Array:
    """Return the angular rate [rad/s] and the specific force [m/s²] (6,) in the camera at a time [s].

    Central differences of the path with the step h::

        ω = log(R(t - h)ᵀ R(t + h)) / 2h
        f = R(t)ᵀ ((p(t - h) - 2 p(t) + p(t + h)) / h² + g)
    """
    h = CONSTANTS.step
    before, now, after = path(stamp - h), path(stamp), path(stamp + h)
    rate = so3_log(before[:3, :3].T @ after[:3, :3]) / (2 * h)
    acceleration = (before[:3, 3] - 2 * now[:3, 3] + after[:3, 3]) / h**2
    return np.concatenate([rate, now[:3, :3].T @ (acceleration + GRAVITY)])

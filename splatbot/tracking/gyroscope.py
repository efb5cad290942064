"""Rotation of a camera between two frames by its gyroscope, whose bias and agreement with tracking are observed."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from splatbot.geometry import skew, so3_exp, so3_log
from splatbot.imu import ImuSamples

Array = NDArray[np.float64]
Trust = Literal["new", "proven", "doubted"]

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class GyroscopeConstants:
    """Errors of the gyroscopes in depth cameras, and limits of their use."""

    noise: float = 5e-4
    """White noise [rad/s/√Hz]: twice that of a BMI055 or BNO086."""
    bias: float = 0.03
    """Standard deviation [rad/s] of an unknown bias; data sheets state up to 1°/s."""
    bias_walk: float = 5e-4
    """Change of the bias [rad/s/√s]."""
    scale: float = 0.01
    """Standard deviation [1] of the scale, and of the angle [rad] between the axes of the sensor and the camera."""
    clock: float = 2e-3
    """Standard deviation [s] of the difference of the clocks."""
    angular_acceleration: float = 20.0
    """Angular acceleration [rad/s²] in the time from the last sample to the frame."""
    tracking: float = 2e-3
    """Standard deviation [rad] of errors of tracked rotations that their covariance lacks: bias is learned slowly."""
    max_gap: float = 0.03
    """Longest time [s] without a sample."""
    max_time: float = 1.0
    """Longest time [s] between two tracked frames. The error of a bias grows with it."""
    max_samples: int = 2000
    """Largest number of samples between two tracked frames, which bounds the work."""
    saturated: float = 4.0
    """Angular rate [rad/s] from which two equal successive values are the end of the sensor's range."""
    max_rate: float = 100.0
    """Largest angular rate [rad/s] of a sample that can be true; sensors end at 35 to 70 rad/s."""
    gate: float = 21.11
    """99.99 % quantile of χ² with 3 degrees of freedom."""
    moving: float = 0.03
    """Rotation [rad] between two tracked frames from which they are evidence for or against the gyroscope."""
    right: float = 0.3
    """Largest difference of the tracked rotation, relative to its size [1], that is evidence for the gyroscope."""
    wrong: float = 0.7
    """Least such difference that is evidence against it. Axes that are wrong by 45° give 0.77. A frame that is tracked
    badly may contradict a right gyroscope by many σ, but a motion of many degrees has the right size and axis."""
    record: int = 6
    """Frames by which one kind of evidence must exceed the other until the gyroscope is proven or doubted."""


CONSTANTS = GyroscopeConstants()


@dataclass(frozen=True, eq=False)
class MeasuredTurn:
    """Rotation from the last tracked frame to a frame, by the gyroscope.

    Args:
        R_last_camera: (3, 3) axes of the camera at the frame, in those at the last tracked frame.
        rate: (3,) angular rate [rad/s] at the frame, in the camera.
        covariance: (6, 6) of the errors (φ [rad], ω [rad/s]): R_last_camera exp(φ) and rate + ω are the true values.
        bias_jacobian: (3, 3) [s] derivative of φ by the bias.
        seconds: time [s] of the rotation.
        trust: "doubted" if the gyroscope has contradicted tracking: the rotation is compared but not used. "proven" if
            it has agreed in motion: a tracked rotation that contradicts it is doubted instead.
    """

    R_last_camera: Array
    rate: Array
    covariance: Array
    bias_jacobian: Array
    seconds: float
    trust: Trust = "new"

    @property
    def is_doubted(self) -> bool:
        """Return whether the rotation is not used."""
        return self.trust == "doubted"

    def distance(self, R_last_camera: Array, covariance: Array) -> float:
        """Return the squared Mahalanobis distance [1] of a rotation (3, 3) with a covariance (3, 3) [rad²]."""
        delta = so3_log(self.R_last_camera.T @ R_last_camera)
        return float(delta @ np.linalg.solve(self.covariance[:3, :3] + covariance, delta))

    def agrees(self, R_last_camera: Array, covariance: Array) -> bool:
        """Return whether a rotation (3, 3) with a covariance (3, 3) [rad²] passes the χ² gate."""
        return self.distance(R_last_camera, covariance) <= CONSTANTS.gate


class Gyroscope:
    """The gyroscope of a camera: recent samples, the bias and the trust in it.

    The bias is a Kalman filter of 3 states that walk at random. Its measurements are the differences between tracked
    rotations and those of the gyroscope. Successive tracked rotations share a pose, whose errors cancel in their sum.
    The filter counts them as independent, so that it converges later than it could.
    """

    def __init__(self) -> None:
        self.bias: Array = np.zeros(3)
        self.bias_covariance: Array = CONSTANTS.bias**2 * np.eye(3)
        self._recent: Array = np.zeros((0, 4))  # stamps and rates since the last tracked frame
        self._record = 0  # evidence for the gyroscope less that against it, within ± CONSTANTS.record
        self._trust: Trust = "new"

    def measure(self, imu: ImuSamples | None, last: float | None, stamp: float) -> MeasuredTurn | None:
        """Add the samples of a frame, and return the rotation since the last tracked frame.

        Args:
            imu: samples of the frame; None for a camera without an IMU.
            last: time [s] of the last tracked frame; None at the start.
            stamp: time [s] of the frame.

        Returns:
            The rotation, or None if samples are missing or saturated, or the time is too long.
        """
        if imu is None and not len(self._recent):
            return None
        since = stamp - CONSTANTS.max_time if last is None else max(last, stamp - CONSTANTS.max_time)
        self._recent = _joined(self._recent, imu, since - CONSTANTS.max_gap, stamp + CONSTANTS.max_gap)
        if last is None or not 0 < stamp - last <= CONSTANTS.max_time:
            return None
        return integrate(self._recent, (last, stamp), self.bias, self.bias_covariance, self._trust)

    def observe(self, turn: MeasuredTurn, R_last_camera: Array, covariance: Array) -> None:
        """Update the trust by a tracked rotation (3, 3) with a covariance (3, 3) [rad²], and the bias if it agrees."""
        rotations = (turn.R_last_camera.T @ R_last_camera, turn.R_last_camera, R_last_camera)
        difference, *sizes = (float(np.linalg.norm(so3_log(R))) for R in rotations)
        if max(sizes) >= CONSTANTS.moving:
            share = difference / max(sizes)
            self._count(int(share <= CONSTANTS.right) - int(share >= CONSTANTS.wrong))
        if not turn.agrees(R_last_camera, covariance):
            return
        walk = CONSTANTS.bias_walk**2 * turn.seconds
        P, J = self.bias_covariance + walk * np.eye(3), turn.bias_jacobian
        measured = turn.covariance[:3, :3] + covariance + CONSTANTS.tracking**2 * np.eye(3)
        gain = np.linalg.solve(measured, J @ P).T
        self.bias = self.bias + gain @ so3_log(turn.R_last_camera.T @ R_last_camera)
        P = P - gain @ J @ P
        self.bias_covariance = 0.5 * (P + P.T)

    def _count(self, change: int) -> None:
        """Change the record; trust that is lost or proven changes again where the record returns to 0."""
        self._record = min(max(self._record + change, -CONSTANTS.record), CONSTANTS.record)
        if self._record == 0:
            self._trust = "new"
        elif self._record == CONSTANTS.record:
            self._trust = "proven"
        elif self._record == -CONSTANTS.record and self._trust != "doubted":
            self._trust = "doubted"
            _log.warning(
                "the gyroscope contradicts the tracked rotation and is not used: check its axes, clock and range"
            )


def integrate(
    samples: Array, interval: tuple[float, float], bias: Array, bias_covariance: Array, trust: Trust = "new"
) -> MeasuredTurn | None:
    """Integrate angular rates over an interval (preintegration on SO(3), Forster et al. 2017, equations 35 and 44).

    Rates are linear between samples, so that each step turns by its mean rate ω_k. With the step dt_k::

        R = Π exp((ω_k - b) dt_k)
        J ← exp((ω_k - b) dt_k)ᵀ J - dt_k 1

    White noise is isotropic: its covariance is noise² times the time in all axes. Errors of bias, scale, axes and clock
    add to it, and the acceleration in the time after the last sample.

    Args:
        samples: (N, 4) rows of increasing stamps [s] and rates [rad/s].
        interval: first and last time [s].
        bias: (3,) [rad/s].
        bias_covariance: (3, 3) [rad²/s²].
        trust: trust in the gyroscope, for the result.

    Returns:
        The rotation, or None if there is a gap, if rates are saturated or absurd, or if there are too many samples.
    """
    p, (start, stop) = CONSTANTS, interval
    near = samples[(samples[:, 0] > start - p.max_gap) & (samples[:, 0] < stop + p.max_gap)]
    if not 0 < len(near) <= p.max_samples or np.abs(near[:, 1:]).max() > p.max_rate or _is_saturated(near[:, 1:]):
        return None
    stamps = near[:, 0]
    times = np.concatenate([[start], stamps[(stamps > start) & (stamps < stop)], [stop]])
    if max(np.diff(times).max(), np.diff(stamps).max(initial=0.0)) > p.max_gap or stamps[-1] < stop - p.max_gap:
        return None
    rates = np.column_stack([np.interp(times, stamps, near[:, axis]) for axis in (1, 2, 3)]) - bias
    R, J = np.eye(3), np.zeros((3, 3))
    steps = np.diff(times)
    for dt, rate in zip(steps.tolist(), 0.5 * (rates[1:] + rates[:-1]), strict=True):
        step = so3_exp(dt * rate)
        R, J = R @ step, step.T @ J - dt * (np.eye(3) - 0.5 * skew(dt * rate))
    turned, end = float(np.linalg.norm(rates, axis=1).max() * (stop - start)), rates[-1]
    held, change = max(stop - stamps[-1], 0.0), rates[-1] - rates[0]
    period = float(np.median(np.diff(stamps))) if len(stamps) > 1 else p.max_gap
    covariance = np.zeros((6, 6))
    covariance[:3, :3] = J @ bias_covariance @ J.T + p.clock**2 * np.outer(change, change)
    covariance[:3, :3] += (
        p.noise**2 * (stop - start) + (p.scale * turned) ** 2 + (0.5 * p.angular_acceleration * held**2) ** 2
    ) * np.eye(3)
    delay = held + p.clock
    covariance[3:, 3:] = bias_covariance + (
        p.noise**2 / period + (p.scale * float(np.linalg.norm(end))) ** 2 + (p.angular_acceleration * delay) ** 2
    ) * np.eye(3)
    covariance[:3, 3:] = -J @ bias_covariance
    covariance[3:, :3] = covariance[:3, 3:].T
    return MeasuredTurn(R, end, covariance, J, stop - start, trust)


def _is_saturated(rates: Array) -> bool:
    """Return whether two successive rates (N, 3) [rad/s] are large and equal, as at the end of a sensor's range."""
    large = np.abs(rates[1:]) >= CONSTANTS.saturated
    return bool((large & (rates[1:] == rates[:-1])).any())


def _joined(recent: Array, imu: ImuSamples | None, oldest: float, newest: float) -> Array:
    """Return rows (N, 4) between two times [s], with those of further samples; late samples take their place."""
    rows = recent if imu is None else np.concatenate([recent, imu.gyroscope])
    rows = rows[(rows[:, 0] > oldest) & (rows[:, 0] <= newest)]
    _, first = np.unique(rows[:, 0], return_index=True)
    return rows[first]

"""Prediction of the camera pose before the frame is aligned."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.frame import PosePrior
from splatbot.geometry import adjoint, inverse, se3_exp, se3_log, so3_log
from splatbot.tracking.gyroscope import MeasuredTurn

Array = NDArray[np.float64]


@dataclass(frozen=True)
class MotionModelConstants:
    """Empirical constants of the constant-velocity model.

    The standard deviation of the predicted translation is ``rest + |predicted motion| / 2 + acceleration dt² / 2``,
    and that of the rotation likewise. Larger values let alignment move the pose further from the prediction.
    """

    rest: float = 5e-3
    """Standard deviation [m] and [rad] of a camera that does not move."""
    acceleration: float = 2.0
    """Unmodelled acceleration [m/s²]."""
    angular_acceleration: float = 4.0
    """Unmodelled angular acceleration [rad/s²]."""
    max_gap: float = 3.0
    """Gap between frames, in previous intervals [1], after which the velocity is no longer used."""
    same_time: float = 2e-3
    """Time [s] in which a camera on an arm moves by less than the error of its pose."""


CONSTANTS = MotionModelConstants()


@dataclass(frozen=True, eq=False)
class Prediction:
    """Predicted pose: the motion prior of the constant-velocity model, or the robot prior of a frame.

    Args:
        T_world_camera: (4, 4).
        covariance: (6, 6) of the twist (t [m], ω [rad]) in the camera's frame.
        absolute: True if the pose is known in the world. If False, it is relative to the previous frame.
        turn: rotation since the last pose by a gyroscope, which a motion prior contains unless it is doubted.
    """

    T_world_camera: Array
    covariance: Array
    absolute: bool = False
    turn: MeasuredTurn | None = None


class ConstantVelocity:
    """Constant-velocity motion model: the last twist continues, in proportion to the time that has passed.

    A lost frame, or a gap of more than ``CONSTANTS.max_gap`` times the last interval, resets the velocity to zero.
    """

    def __init__(self) -> None:
        self._last: tuple[float, Array] | None = None
        self._twist: Array = np.zeros(6)  # of T_previous_last
        self._interval = 0.0
        self._dead_reckoning: tuple[Array, Array] | None = None  # pose and covariance of a lost frame by robot priors

    @property
    def T_world_camera(self) -> Array:
        """Last known pose (4, 4)."""
        return self._last[1] if self._last is not None else np.eye(4)

    @property
    def stamp(self) -> float | None:
        """Time [s] of the last known pose; None at the start."""
        return None if self._last is None else self._last[0]

    def predict(self, stamp: float) -> Array:
        """Return the expected T_world_camera (4, 4) at a time [s]."""
        return self.T_world_camera @ se3_exp(self._motion(stamp))

    @property
    def velocity(self) -> Array:
        """Mean twist (6,) [m/s, rad/s] between the last two poses, in the camera's frame; zero where it is unknown."""
        return self._twist / self._interval if self._interval > 0 else np.zeros(6)

    def extrapolate(self, stamp: float) -> Array | None:
        """Return T_world_camera (4, 4) at a time [s], or None where the motion does not determine it.

        The motion is known at the last pose, and for ``CONSTANTS.max_gap`` intervals after the second or a later pose.
        """
        if self._last is None:
            return None
        dt = stamp - self._last[0]
        if abs(dt) <= CONSTANTS.same_time:
            return self._last[1]
        return self.predict(stamp) if 0.0 < dt <= CONSTANTS.max_gap * self._interval else None

    def extrapolation_covariance(self, stamp: float) -> Array:
        """Return the covariance (6, 6) by which unmodelled accelerations add to the last pose until a time [s]."""
        dt = max(stamp - self._last[0], 0.0) if self._last is not None else 0.0
        sigma = 0.5 * dt**2 * np.array(3 * [CONSTANTS.acceleration] + 3 * [CONSTANTS.angular_acceleration])
        return np.diag(sigma**2)

    def motion_prior(self, stamp: float, last_covariance: Array, turn: MeasuredTurn | None = None) -> Prediction:
        """Predict the pose at a time [s] with its covariance.

        Args:
            stamp: the time.
            last_covariance: (6, 6) of the last pose.
            turn: rotation since the last pose by a gyroscope. It replaces that of the model unless it is doubted.
        """
        motion = self._motion(stamp)
        dt = max(stamp - self._last[0], 0.0) if self._last is not None else 0.0
        p = CONSTANTS
        shift = p.rest + 0.5 * float(np.linalg.norm(motion[:3])) + 0.5 * p.acceleration * dt**2
        turn_sigma = min(p.rest + 0.5 * float(np.linalg.norm(motion[3:])) + 0.5 * p.angular_acceleration * dt**2, np.pi)
        process_noise = np.diag([shift**2] * 3 + [turn_sigma**2] * 3)
        if turn is not None and not turn.is_doubted:
            motion = np.concatenate([motion[:3], so3_log(turn.R_last_camera)])
            process_noise[3:, 3:] = turn.covariance[:3, :3] + p.rest**2 * np.eye(3)
        T = self.T_world_camera @ se3_exp(motion)
        return Prediction(T, _transported(last_covariance, motion) + process_noise, turn=turn)

    def robot_prior(self, prior: PosePrior, last_covariance: Array) -> Prediction:
        """Return the pose that the robot reports; relative motions of lost frames accumulate until one is tracked."""
        if prior.T_world_camera is not None:
            return Prediction(prior.T_world_camera, prior.covariance, absolute=True)
        step = np.eye(4) if prior.T_previous_camera is None else prior.T_previous_camera
        T, covariance = self._dead_reckoning or (self.T_world_camera, last_covariance)
        return Prediction(T @ step, _transported(covariance, se3_log(step)) + prior.covariance)

    def update(self, stamp: float, T_world_camera: Array) -> None:
        """Update the velocity with the estimated pose (4, 4) of a frame."""
        if self._last is not None:
            self._interval = stamp - self._last[0]
            self._twist = se3_log(inverse(self._last[1]) @ T_world_camera)
        self._last = (stamp, T_world_camera)
        self._dead_reckoning = None

    def move(self, T_new_old: Array) -> None:
        """Move the last pose with a correction (4, 4) of the map; the velocity stays."""
        if self._last is not None:
            self._last = (self._last[0], T_new_old @ self._last[1])
        if self._dead_reckoning is not None:
            self._dead_reckoning = (T_new_old @ self._dead_reckoning[0], self._dead_reckoning[1])

    def forget_velocity(self, robot_prior: Prediction | None = None) -> None:
        """Restart from rest after a lost frame, at the last known pose or at the pose that the robot reports."""
        self._interval = 0.0
        if robot_prior is not None:
            self._dead_reckoning = (robot_prior.T_world_camera, robot_prior.covariance)

    def _motion(self, stamp: float) -> Array:
        """Compute the twist (6,) from the last pose to a time [s]."""
        if self._last is None or self._interval <= 0:
            return np.zeros(6)
        ratio = (stamp - self._last[0]) / self._interval
        return ratio * self._twist if 0 < ratio <= CONSTANTS.max_gap else np.zeros(6)


def _transported(covariance: Array, motion: Array) -> Array:
    """Transport a covariance (6, 6) to the frame of a camera that has moved by a twist (6,): Ad Σ Adᵀ."""
    A = adjoint(se3_exp(-motion))
    moved: Array = A @ covariance @ A.T
    return moved

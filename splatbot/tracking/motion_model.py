"""Where the camera should be before the frame is looked at."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.frame import PosePrior
from splatbot.geometry import adjoint, inverse, se3_exp, se3_log

Array = NDArray[np.float64]

# How far a camera strays from constant velocity in a time dt: rest + half the predicted motion + acceleration dt²/2.
_REST = 5e-3  # [m] and [rad]
_ACCELERATION = 2.0  # [m/s²]
_ANGULAR_ACCELERATION = 4.0  # [rad/s²]


@dataclass(frozen=True, eq=False)
class Prediction:
    """T_world_camera (4, 4) expected, and the covariance (6, 6) of its twist (t [m], ω [rad]) in the camera's frame.

    ``absolute`` says that it is known against the world, and not against the frame before.
    """

    T_world_camera: Array
    covariance: Array
    absolute: bool = False


class ConstantVelocity:
    """Predicts that the last motion goes on, in proportion to the time passed.

    A gap of more than ``max_gap`` times the last interval, or a lost frame, forgets the velocity.
    """

    max_gap = 3.0

    def __init__(self) -> None:
        self._last: tuple[float, Array] | None = None
        self._twist: Array = np.zeros(6)  # of T_previous_last
        self._interval = 0.0
        self._reckoned: tuple[Array, Array] | None = None  # pose and covariance of a frame that only a robot told of

    @property
    def T_world_camera(self) -> Array:
        """The last known pose (4, 4)."""
        return self._last[1] if self._last is not None else np.eye(4)

    def predict(self, stamp: float) -> Array:
        """T_world_camera (4, 4) expected at a time [s]."""
        return self.T_world_camera @ se3_exp(self._motion(stamp))

    def prediction(self, stamp: float, last_covariance: Array) -> Prediction:
        """The same with its covariance; ``last_covariance`` (6, 6) is that of the last known pose."""
        motion = self._motion(stamp)
        dt = max(stamp - self._last[0], 0.0) if self._last is not None else 0.0
        shift = _REST + 0.5 * float(np.linalg.norm(motion[:3])) + 0.5 * _ACCELERATION * dt**2
        turn = min(_REST + 0.5 * float(np.linalg.norm(motion[3:])) + 0.5 * _ANGULAR_ACCELERATION * dt**2, np.pi)
        strays = np.diag([shift**2] * 3 + [turn**2] * 3)
        T = self.T_world_camera @ se3_exp(motion)
        return Prediction(T, _moved(last_covariance, motion) + strays)

    def told(self, prior: PosePrior, last_covariance: Array) -> Prediction:
        """What a robot says of this frame; relative motions of lost frames add up until a pose is known again."""
        if prior.T_world_camera is not None:
            return Prediction(prior.T_world_camera, prior.covariance, absolute=True)
        step = np.eye(4) if prior.T_previous_camera is None else prior.T_previous_camera
        T, covariance = self._reckoned or (self.T_world_camera, last_covariance)
        return Prediction(T @ step, _moved(covariance, se3_log(step)) + prior.covariance)

    def update(self, stamp: float, T_world_camera: Array) -> None:
        """Tell the pose that a frame was found to have."""
        if self._last is not None:
            self._interval = stamp - self._last[0]
            self._twist = se3_log(inverse(self._last[1]) @ T_world_camera)
        self._last = (stamp, T_world_camera)
        self._reckoned = None

    def move(self, T_new_old: Array) -> None:
        """The world was moved: the last pose is another, the motion is the same."""
        if self._last is not None:
            self._last = (self._last[0], T_new_old @ self._last[1])
        if self._reckoned is not None:
            self._reckoned = (T_new_old @ self._reckoned[0], self._reckoned[1])

    def forget_velocity(self, told: Prediction | None = None) -> None:
        """After a lost frame: start again from rest at the last known pose, or from where a robot says it is."""
        self._interval = 0.0
        if told is not None:
            self._reckoned = (told.T_world_camera, told.covariance)

    def _motion(self, stamp: float) -> Array:
        """Twist (6,) from the last pose to a time [s]."""
        if self._last is None or self._interval <= 0:
            return np.zeros(6)
        ratio = (stamp - self._last[0]) / self._interval
        return ratio * self._twist if 0 < ratio <= self.max_gap else np.zeros(6)


def _moved(covariance: Array, motion: Array) -> Array:
    """A covariance (6, 6) of one camera's frame in that of another, ``motion`` (6,) away."""
    A = adjoint(se3_exp(-motion))
    moved: Array = A @ covariance @ A.T
    return moved

"""Where the camera should be before the frame is looked at."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.geometry import inverse, se3_exp, se3_log

Array = NDArray[np.float64]


class ConstantVelocity:
    """Predicts that the last motion goes on, in proportion to the time passed.

    A gap of more than ``max_gap`` times the last interval, or a lost frame, forgets the velocity.
    """

    max_gap = 3.0

    def __init__(self) -> None:
        self._last: tuple[float, Array] | None = None
        self._twist: Array = np.zeros(6)  # of T_previous_last
        self._interval = 0.0

    @property
    def T_world_camera(self) -> Array:
        """The last known pose (4, 4)."""
        return self._last[1] if self._last is not None else np.eye(4)

    def predict(self, stamp: float) -> Array:
        """T_world_camera (4, 4) expected at a time [s]."""
        if self._last is None or self._interval <= 0:
            return self.T_world_camera
        ratio = (stamp - self._last[0]) / self._interval
        if not 0 < ratio <= self.max_gap:
            return self.T_world_camera
        return self.T_world_camera @ se3_exp(ratio * self._twist)

    def update(self, stamp: float, T_world_camera: Array) -> None:
        """Tell the pose that a frame was found to have."""
        if self._last is not None:
            self._interval = stamp - self._last[0]
            self._twist = se3_log(inverse(self._last[1]) @ T_world_camera)
        self._last = (stamp, T_world_camera)

    def forget_velocity(self) -> None:
        """After a lost frame: start again from rest at the last known pose."""
        self._interval = 0.0

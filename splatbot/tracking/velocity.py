"""Velocity of the camera within a frame, from the poses of the last frames."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.geometry import inverse, se3_log

Array = NDArray[np.float64]


@dataclass(frozen=True)
class VelocityConstants:
    """Constants of the velocity model."""

    max_gap: float = 0.15
    """Longest time [s] between two frames over which the acceleration of a hand is nearly constant. Over a longer one
    the velocity is unknown."""


CONSTANTS = VelocityConstants()


class CameraVelocity:
    """Twist of the camera at a time under constant acceleration, by the poses of the last three frames."""

    def __init__(self) -> None:
        self._poses: deque[tuple[float, Array]] = deque(maxlen=3)

    def update(self, stamp: float, T_world_camera: Array) -> None:
        """Append the pose (4, 4) of a frame at a time [s]."""
        self._poses.append((stamp, T_world_camera))

    def move(self, T_new_old: Array) -> None:
        """Move the last poses with a correction (4, 4) of the map."""
        self._poses = deque(((stamp, T_new_old @ T) for stamp, T in self._poses), maxlen=3)

    def forget(self) -> None:
        """Discard the poses, after a lost frame."""
        self._poses.clear()

    def at(self, stamp: float, T_world_camera: Array | None = None) -> Array:
        """Return the twist (6,) [m/s, rad/s] of the camera at a time [s], in its own frame.

        The twist between two frames is the mean velocity, that of the time in the middle. It is extrapolated from the
        last two of them. With one it is that, and with none it is zero.

        Args:
            stamp: time [s].
            T_world_camera: (4, 4) pose at this time. If None, only the earlier ones are used.
        """
        poses = [*self._poses, *([] if T_world_camera is None else [(stamp, T_world_camera)])][-3:]
        times, twists = [], []
        for (t0, T0), (t1, T1) in zip(poses, poses[1:], strict=False):
            if 0 < t1 - t0 <= CONSTANTS.max_gap:
                times.append(0.5 * (t0 + t1))
                twists.append(se3_log(inverse(T0) @ T1) / (t1 - t0))
        if not twists or stamp - poses[-1][0] > CONSTANTS.max_gap:
            return np.zeros(6)
        if len(twists) == 1:
            return twists[0]
        acceleration = (twists[1] - twists[0]) / (times[1] - times[0])
        return np.asarray(twists[1] + (stamp - times[1]) * acceleration)

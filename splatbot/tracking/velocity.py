"""Velocity of the camera within a frame, from the poses of the last frames."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from splatbot.geometry import inverse, se3_log
from splatbot.tracking.align import Alignment

Array = NDArray[np.float64]


@dataclass(frozen=True)
class VelocityConstants:
    """Constants of the velocity model."""

    max_gap: float = 0.15
    """Longest time [s] between two frames over which the acceleration of a hand is nearly constant. Over a longer one
    the velocity is unknown."""
    acceleration: float = 2.0
    """Change of the acceleration between two frames [m/s²]. A larger value trusts the rows of the frame more."""
    angular_acceleration: float = 6.0
    """Change of the angular acceleration between two frames [rad/s²]."""
    unknown: float = 1.0
    """Standard deviation of an unknown velocity [m/s], and of an unknown angular velocity in 2 [rad/s]."""


CONSTANTS = VelocityConstants()

_DAMPING = 1e-3  # information [1/m², 1/rad²] of any pose, as in splatbot.tracking.uncertainty


class CameraVelocity:
    """Twist of the camera at a time under constant acceleration, by the poses of the last three frames."""

    def __init__(self) -> None:
        self._poses: list[tuple[float, Array]] = []

    def update(self, stamp: float, T_world_camera: Array) -> None:
        """Append the pose (4, 4) of a frame at a time [s]."""
        self._poses = [*self._poses, (stamp, T_world_camera)][-3:]

    def move(self, T_new_old: Array) -> None:
        """Move the last poses with a correction (4, 4) of the map."""
        self._poses = [(stamp, T_new_old @ T) for stamp, T in self._poses]

    def forget(self) -> None:
        """Discard the poses, after a lost frame."""
        self._poses.clear()

    def sigma(self, stamp: float) -> Array:
        """Return the standard deviations (6,) [m/s, rad/s] of the twist at a time [s] under the motion model."""
        p, gap = CONSTANTS, stamp - self._poses[-1][0] if self._poses else np.inf
        if gap > p.max_gap or len(self._poses) < 2:
            return np.repeat([p.unknown, 2 * p.unknown], 3)
        return np.repeat([p.acceleration * gap, p.angular_acceleration * gap], 3)

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
        for (t0, T0), (t1, T1) in pairwise(poses):
            if 0 < t1 - t0 <= CONSTANTS.max_gap:
                times.append(0.5 * (t0 + t1))
                twists.append(se3_log(inverse(T0) @ T1) / (t1 - t0))
        if not twists or stamp - poses[-1][0] > CONSTANTS.max_gap:
            return np.zeros(6)
        if len(twists) == 1:
            return twists[0]
        acceleration = (twists[1] - twists[0]) / (times[1] - times[0])
        return np.asarray(twists[1] + (stamp - times[1]) * acceleration)


def mean_twist(T_first_second: Array, seconds: float) -> Array:
    """Return the mean twist (6,) [m/s, rad/s] of a motion (4, 4); zero over more than ``CONSTANTS.max_gap``."""
    return se3_log(T_first_second) / seconds if 0 < seconds <= CONSTANTS.max_gap else np.zeros(6)


def twist_of_rows(alignment: Alignment, used: Array, prior: Array, sigma: Array, readout: float) -> Array:
    """Estimate the twist (6,) of the camera during a frame from its residuals and a prior.

    The residuals of a rectified image depend on the pose and on the error of its twist. A left
    increment δ of T_camera_world and a correction η of the twist move a point by δ - s η, s seconds after the stamp.
    With the normal equations (H_b, g_b) of bands of rows at times s_b and the information Λ of the prior, η solves::

        [Σ H_b        -Σ s_b H_b     ] [δ]   [-Σ g_b                  ]
        [-Σ s_b H_b   Σ s_b² H_b + Λ ] [η] = [Σ s_b g_b + Λ (prior - used)]

    Args:
        alignment: alignment of the rectified image.
        used: (6,) twist [m/s, rad/s] with which it was rectified.
        prior: (6,) mean of the prior.
        sigma: (6,) standard deviations of the prior.
        readout: time from the first row to the last [s].
    """
    bands = len(alignment.band_gradient)
    s = ((np.arange(bands) + 0.5) / max(bands, 1) - 0.5) * readout
    H, g, information = alignment.band_information, alignment.band_gradient, np.diag(1 / sigma**2)
    H0, H1, H2 = (np.einsum("b,bij->ij", s**k, H) for k in range(3))
    A = np.block([[H0 + _DAMPING * np.eye(6), -H1], [-H1, H2 + information]])
    b = np.concatenate([-g.sum(0), s @ g + information @ (prior - used)])
    if not np.isfinite(A).all() or not np.isfinite(b).all():
        return prior
    return np.asarray(used + np.linalg.solve(A, b)[6:])

"""A motion that a ROS client sends: joint positions at times."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from splatbot.protocols import Array


class Waypoints:
    """A cubic curve through positions at times (Hermite, with Catmull-Rom's velocities), at rest at both ends.

    Args:
        times: (N,) increasing [s]; from the start to the first the arm waits.
        positions: (N, J) [rad or m].
    """

    def __init__(self, times: ArrayLike, positions: ArrayLike) -> None:
        self.times, self.positions = np.asarray(times, np.float64), np.asarray(positions, np.float64)
        self._velocities = np.zeros_like(self.positions)
        if len(self.times) > 2:
            spans = (self.times[2:] - self.times[:-2])[:, None]
            self._velocities[1:-1] = (self.positions[2:] - self.positions[:-2]) / spans

    @property
    def duration(self) -> float:
        """[s]"""
        return float(self.times[-1])

    def reference(self, t: float) -> tuple[Array, Array]:
        """Position and velocity (J,) at a time [s] since the start; at rest at the ends before and after."""
        if t <= self.times[0] or t >= self.times[-1] or len(self.times) == 1:
            at = 0 if t <= self.times[0] else -1
            return self.positions[at].copy(), np.zeros(self.positions.shape[1])
        i = int(np.searchsorted(self.times, t, side="right")) - 1
        h = self.times[i + 1] - self.times[i]
        u = (t - self.times[i]) / h
        p, q, v, w = self.positions[i], self.positions[i + 1], h * self._velocities[i], h * self._velocities[i + 1]
        a, b = 2 * (p - q) + v + w, 3 * (q - p) - 2 * v - w
        return p + u * (v + u * (b + u * a)), (v + u * (2 * b + 3 * u * a)) / h

"""Robot motion, detected from joint positions."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class JointMotionMonitor:
    """Compares the joint positions of consecutive frames.

    Args:
        still_speed: a joint below this speed counts as still [rad/s].
    """

    def __init__(self, still_speed: float) -> None:
        self.still_speed = still_speed
        self._last: tuple[float, NDArray[np.float64]] | None = None

    def update(self, stamp: float, joints: NDArray[np.float64] | None) -> bool:
        """Return whether a joint has moved since the last call; False if the joints or the interval are unknown.

        Args:
            stamp: time [s].
            joints: (n,) [rad]; None if the robot reports none.
        """
        last = self._last
        self._last = (stamp, np.array(joints, dtype=np.float64)) if joints is not None else None
        if last is None or self._last is None or last[1].shape != self._last[1].shape or stamp <= last[0]:
            return False
        return bool(np.abs(self._last[1] - last[1]).max(initial=0.0) > self.still_speed * (stamp - last[0]))

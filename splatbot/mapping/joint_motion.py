"""Whether the robot moves, by its joints."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray


class JointMotionMonitor:
    """Compares joint positions of one frame with the next.

    Args:
        still: joints that move slower than this stand still [rad/s].
    """

    def __init__(self, still: float) -> None:
        self.still = still
        self._last: tuple[float, NDArray[np.float64]] | None = None

    def update(self, stamp: float, joints: NDArray[np.float64] | None) -> bool:
        """Whether any joint has moved since the last call; False where nothing can be said.

        Args:
            stamp: time [s].
            joints: (n,) [rad]; None where the robot told none.
        """
        last = self._last
        self._last = (stamp, np.array(joints, dtype=np.float64)) if joints is not None else None
        if last is None or self._last is None or last[1].shape != self._last[1].shape or stamp <= last[0]:
            return False
        return bool(np.abs(self._last[1] - last[1]).max(initial=0.0) > self.still * (stamp - last[0]))

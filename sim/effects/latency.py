"""Frames that arrive late and are stamped on arrival."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from splatbot.frame import Frame
from splatbot.sim.effects.base import SensorEffect, setting


@dataclass(frozen=True)
class Latency(SensorEffect, cost="a random number for a frame", observable="stamps"):
    """Simulated latency: the stamp is the arrival time t + delay + U(0, jitter), and the images are those of t.

    Joints and poses that are paired by stamp are therefore later than the images, as with a driver that stamps on
    arrival. A twin's camera delays the frame and adds the joints of the arrival time. Effects that need the camera pose
    at the stamp (motion_blur, rolling_shutter) must come before this one.

    Args:
        delay: minimum latency [s].
        jitter: range [s] of the uniform random addition. It must be below the frame period, or frames change order.

    Raises:
        InputError: an argument is out of range.
    """

    delay: float = setting(0.05, "give seconds >= 0", low=0)
    jitter: float = setting(0.0, "give seconds >= 0", low=0)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Stamp the frame with its arrival time."""
        return replace(frame, stamp=frame.stamp + self.delay + self.jitter * float(rng.random()))

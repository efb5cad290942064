"""Frames that arrive late and are stamped on arrival."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from splatbot.frame import Frame
from splatbot.sim.effects.base import Observable, check_fields


@dataclass(frozen=True)
class Latency:
    """Simulated latency: the stamp is the arrival time t + delay + U(0, jitter), and the images are those of t.

    Joints and poses that are paired by stamp are therefore later than the images, as with a driver that stamps on
    arrival. A twin's camera delays the frame and adds the joints of the arrival time. Effects that need the camera pose
    at the stamp (motion_blur, rolling_shutter) must come before this one.

    Args:
        delay: minimum latency [s].
        jitter: range [s] of the uniform random addition. It must be below the frame period, or frames change order.
        why: reason for the effect.

    Raises:
        InputError: an argument is out of range.
    """

    delay: float = 0.05
    jitter: float = 0.0
    why: str = "requested"
    name: str = "latency"
    cost: ClassVar[str] = "a random number for a frame"
    observable: ClassVar[Observable] = "stamps"

    def __post_init__(self) -> None:
        check_fields(self, "delay", "jitter", hint="give seconds >= 0")

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Stamp the frame with its arrival time."""
        return replace(frame, stamp=frame.stamp + self.delay + self.jitter * float(rng.random()))

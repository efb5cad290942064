"""Frames that arrive late, and are stamped then."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.sim.effects.base import Observable


@dataclass(frozen=True)
class Latency:
    """A frame's stamp is the time at which it arrives, not that at which it was taken; its images stay those.

    What is paired with it by stamp (joints, poses) is then later than the images, as with a driver that stamps on
    arrival. A twin's camera holds the frame back until then, and adds the joints of that moment. Effects that ask
    where the camera was at the stamp (motion_blur, rolling_shutter) belong before it.

    Args:
        delay: least time on the way [s].
        jitter: at most this is added, evenly [s]; below the time between frames, else they overtake each other.
        why: who asked for it.

    Raises:
        InputError: an argument is out of range.
    """

    delay: float = 0.05
    jitter: float = 0.0
    why: str = "asked for"
    name: str = "latency"
    cost: ClassVar[str] = "a random number for a frame"
    observable: ClassVar[Observable] = "stamps"

    def __post_init__(self) -> None:
        for name in ("delay", "jitter"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise InputError(f"is {getattr(self, name)}.", field=name, hint="give seconds >= 0")

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame with its time of arrival."""
        return replace(frame, stamp=frame.stamp + self.delay + self.jitter * float(rng.random()))

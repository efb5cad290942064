"""Frames that never arrive, as over a busy USB bus or network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.sim.effects.base import Observable, check_fields


@dataclass(frozen=True)
class FrameDrops:
    """Simulated random loss of frames; the others keep their stamps.

    Args:
        rate: fraction of the frames that is lost, 0..1.
        burst: frames that are lost together: each group of this many consecutive frames is kept or lost as a whole.
        why: reason for the effect.

    Raises:
        InputError: an argument is out of range.
    """

    rate: float = 0.1
    burst: int = 1
    why: str = "requested"
    name: str = "frame_drops"
    cost: ClassVar[str] = "a random number for a frame"
    observable: ClassVar[Observable] = "arrivals"

    def __post_init__(self) -> None:
        if not 0 <= self.rate < 1:
            raise InputError(f"is {self.rate}.", field="rate", hint="give a share in 0..1, 1 excluded")
        check_fields(self, "burst", low=1, hint="give at least 1 frame")

    def drops(self, index: int, generator: Callable[[int], np.random.Generator]) -> bool:
        """Return whether frame ``index`` is lost; the decision does not need the image, so no image is rendered."""
        return bool(generator(index // self.burst).random() < self.rate)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Return the frame unchanged."""
        return frame

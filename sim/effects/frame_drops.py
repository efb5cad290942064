"""Frames that never arrive, as over a busy USB bus or network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from splatbot.frame import Frame
from splatbot.sim.effects.base import SensorEffect, setting


@dataclass(frozen=True)
class FrameDrops(SensorEffect, cost="a random number for a frame", observable="arrivals"):
    """Simulated random loss of frames; the others keep their stamps.

    Args:
        rate: fraction of the frames that is lost, 0..1.
        burst: frames that are lost together: each group of this many consecutive frames is kept or lost as a whole.

    Raises:
        InputError: an argument is out of range.
    """

    rate: float = setting(0.1, "give a share in 0..1, 1 excluded", low=0, below=1)
    burst: int = setting(1, "give at least 1 frame", low=1)

    def drops(self, index: int, generator: Callable[[int], np.random.Generator]) -> bool:
        """Return whether frame ``index`` is lost; the decision does not need the image, so no image is rendered."""
        return bool(generator(index // self.burst).random() < self.rate)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Return the frame unchanged."""
        return frame

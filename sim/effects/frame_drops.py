"""Frames that never arrive, as over a busy USB bus or network."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.sim.effects.base import Observable


@dataclass(frozen=True)
class FrameDrops:
    """Loses frames at random; the others keep their stamps, so the gap shows.

    Args:
        rate: share of the frames that is lost, 0..1.
        burst: frames that are lost together: the stream is cut into groups of this many, each lost as a whole.
        why: who asked for it.

    Raises:
        InputError: an argument is out of range.
    """

    rate: float = 0.1
    burst: int = 1
    why: str = "asked for"
    name: str = "frame_drops"
    cost: ClassVar[str] = "a random number for a frame"
    observable: ClassVar[Observable] = "arrivals"

    def __post_init__(self) -> None:
        if not 0 <= self.rate < 1:
            raise InputError(f"is {self.rate}.", field="rate", hint="give a share in 0..1, 1 excluded")
        if self.burst < 1:
            raise InputError(f"is {self.burst}.", field="burst", hint="give at least 1 frame")

    def drops(self, index: int, generator: Callable[[int], np.random.Generator]) -> bool:
        """Whether frame ``index`` is lost; decided without looking at it, so that it need not be rendered."""
        return bool(generator(index // self.burst).random() < self.rate)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """What arrives is whole."""
        return frame

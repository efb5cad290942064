"""Colours that shift towards red or blue, as when automatic white balance errs or reacts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from splatbot.frame import Frame
from splatbot.sim.effects.base import Observable, check_fields, check_span


@dataclass(frozen=True)
class WhiteBalance:
    """Simulated white balance: v' = clip(gain v, 0, 255) with one gain per channel; depth is unchanged.

    This is the diagonal model of von Kries (1902), applied to 8-bit values without the camera's response curve.

    Args:
        red, green, blue: gains from frame ``at`` on.
        at: first frame of the shift.
        until: first frame after it; 0 for never.
        why: reason for the effect.

    Raises:
        InputError: an argument is out of range.
    """

    red: float = 1.15
    green: float = 1.0
    blue: float = 0.85
    at: int = 0
    until: int = 0
    why: str = "requested"
    name: str = "white_balance"
    cost: ClassVar[str] = "a table look-up for each channel"
    observable: ClassVar[Observable] = "colors"

    def __post_init__(self) -> None:
        check_fields(self, "red", "green", "blue", hint="give a finite gain >= 0")
        check_span(self.at, self.until)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Multiply the colours by the gains."""
        if frame.index < self.at or (self.until and frame.index >= self.until):
            return frame
        gains = np.array([self.red, self.green, self.blue])
        tables = np.clip(np.rint(np.arange(256)[:, None] * gains), 0, 255).astype(np.uint8)
        return replace(frame, rgb=np.stack([tables[frame.rgb[..., k], k] for k in range(3)], axis=-1))

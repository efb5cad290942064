"""Colours that shift towards red or blue, as when automatic white balance errs or reacts."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from splatbot.frame import Frame
from splatbot.sim.effects.base import SensorEffect, check_span, setting


@dataclass(frozen=True)
class WhiteBalance(SensorEffect, cost="a table look-up for each channel", observable="colors"):
    """Simulated white balance: v' = clip(gain v, 0, 255) with one gain per channel; depth is unchanged.

    This is the diagonal model of von Kries (1902), applied to 8-bit values without the camera's response curve.

    Args:
        red, green, blue: gains from frame ``at`` on.
        at: first frame of the shift.
        until: first frame after it; 0 for never.

    Raises:
        InputError: an argument is out of range.
    """

    red: float = setting(1.15, "give a finite gain >= 0", low=0)
    green: float = setting(1.0, "give a finite gain >= 0", low=0)
    blue: float = setting(0.85, "give a finite gain >= 0", low=0)
    at: int = 0
    until: int = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        check_span(self.at, self.until)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Multiply the colours by the gains."""
        if frame.index < self.at or (self.until and frame.index >= self.until):
            return frame
        gains = np.array([self.red, self.green, self.blue])
        tables = np.clip(np.rint(np.arange(256)[:, None] * gains), 0, 255).astype(np.uint8)
        return replace(frame, rgb=np.stack([tables[frame.rgb[..., k], k] for k in range(3)], axis=-1))

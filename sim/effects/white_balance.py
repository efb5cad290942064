"""Colours that shift towards red or blue, as when automatic white balance errs or reacts."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.sim.effects.base import Observable, check_span


@dataclass(frozen=True)
class WhiteBalance:
    """Each colour channel times a gain of its own, clipped to 0..255; depth is untouched.

    Gains for channels are what white balance is (von Kries 1902); 8-bit values are taken as they are.

    Args:
        red, green, blue: gains from frame ``at`` on.
        at: first frame of the shift.
        until: first frame after it; 0 for never.
        why: who asked for it.

    Raises:
        InputError: an argument is out of range.
    """

    red: float = 1.15
    green: float = 1.0
    blue: float = 0.85
    at: int = 0
    until: int = 0
    why: str = "asked for"
    name: str = "white_balance"
    cost: ClassVar[str] = "a table look-up for each channel"
    observable: ClassVar[Observable] = "colors"

    def __post_init__(self) -> None:
        for name in ("red", "green", "blue"):
            if not (np.isfinite(getattr(self, name)) and getattr(self, name) >= 0):
                raise InputError(f"is {getattr(self, name)}.", field=name, hint="give a finite gain >= 0")
        check_span(self.at, self.until)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame in its shifted colours."""
        if frame.index < self.at or (self.until and frame.index >= self.until):
            return frame
        gains = np.array([self.red, self.green, self.blue])
        tables = np.clip(np.rint(np.arange(256)[:, None] * gains), 0, 255).astype(np.uint8)
        return replace(frame, rgb=np.stack([tables[frame.rgb[..., k], k] for k in range(3)], axis=-1))

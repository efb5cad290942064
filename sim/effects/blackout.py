"""Black frames, for example under a hand on the lens or after the light fails."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.sim.effects.base import SensorEffect, setting


@dataclass(frozen=True)
class Blackout(SensorEffect, cost="nothing", observable="colors"):
    """Simulated black frames.

    Args:
        at: first black frame.
        n: number of frames; 15 are half a second at 30 Hz.
        depth: "lost", as under a hand, or "kept", as after a light failure with an active depth sensor.

    Raises:
        InputError: an argument is out of range.
    """

    at: int = setting(30, "give a number of frames >= 0", low=0)
    n: int = setting(15, "give a number of frames >= 0", low=0)
    depth: str = "lost"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.depth not in ("lost", "kept"):
            raise InputError(f"is {self.depth!r}.", field="depth", hint="lost or kept")

    @property
    def blanks_depth(self) -> bool:
        """Return whether black frames lose their depth."""
        return self.depth == "lost" and self.n > 0

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Return a black frame within the span, and the unchanged frame outside."""
        if not self.at <= frame.index < self.at + self.n:
            return frame
        depth = np.zeros_like(frame.depth) if self.blanks_depth else frame.depth
        return replace(frame, rgb=np.zeros_like(frame.rgb), depth=depth)

"""Black frames, for example under a hand on the lens or after the light fails."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.sim.effects.base import Observable, check_fields


@dataclass(frozen=True)
class Blackout:
    """Simulated black frames.

    Args:
        at: first black frame.
        n: number of frames; 15 are half a second at 30 Hz.
        depth: "lost", as under a hand, or "kept", as after a light failure with an active depth sensor.
        why: reason for the effect.

    Raises:
        InputError: an argument is out of range.
    """

    at: int = 30
    n: int = 15
    depth: str = "lost"
    why: str = "requested"
    name: str = "blackout"
    cost: ClassVar[str] = "nothing"
    observable: ClassVar[Observable] = "colors"

    def __post_init__(self) -> None:
        check_fields(self, "at", "n", hint="give a number of frames >= 0")
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

"""Frames in which the camera sees nothing, as with a hand on the lens or the light gone."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.sim.effects.base import Observable


@dataclass(frozen=True)
class Blackout:
    """Black frames.

    Args:
        at: first black frame.
        n: how many: 15 are half a second at 30 Hz.
        depth: "lost", as under a hand; "kept", as when only the light goes and depth has a light of its own.
        why: who asked for it.

    Raises:
        InputError: an argument is out of range.
    """

    at: int = 30
    n: int = 15
    depth: str = "lost"
    why: str = "asked for"
    name: str = "blackout"
    cost: ClassVar[str] = "nothing"
    observable: ClassVar[Observable] = "colors"

    def __post_init__(self) -> None:
        for name in ("at", "n"):
            if getattr(self, name) < 0:
                raise InputError(f"is {getattr(self, name)}.", field=name, hint="give a number of frames >= 0")
        if self.depth not in ("lost", "kept"):
            raise InputError(f"is {self.depth!r}.", field="depth", hint="lost or kept")

    @property
    def blanks_depth(self) -> bool:
        """Whether black frames come without depth."""
        return self.depth == "lost" and self.n > 0

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """A black frame while it is dark, else the frame itself."""
        if not self.at <= frame.index < self.at + self.n:
            return frame
        depth = np.zeros_like(frame.depth) if self.blanks_depth else frame.depth
        return replace(frame, rgb=np.zeros_like(frame.rgb), depth=depth)

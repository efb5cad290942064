"""Colours that flicker: few photons, and the electronics that count them."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import numpy as np

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.sim.effects.base import Observable


@dataclass(frozen=True)
class ColorNoise:
    """Shot and read noise; depth is untouched.

    The linear model of EMVA Standard 1288: a value v of 255 stands for v / 255 of a full well of electrons, whose
    number is Poisson distributed, and reading them adds normal noise. 8-bit values are taken as they are, without a
    camera's response curve.

    Args:
        full_well: electrons at 255; small sensors hold a few thousand. Fewer: noisier, as with a high gain.
        read: standard deviation of reading [electrons].
        why: who asked for it.

    Raises:
        InputError: an argument is out of range.
    """

    full_well: float = 4000.0
    read: float = 8.0
    why: str = "asked for"
    name: str = "color_noise"
    cost: ClassVar[str] = "two random numbers for each pixel and channel"
    observable: ClassVar[Observable] = "colors"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.full_well) and self.full_well >= 1):
            raise InputError(f"is {self.full_well}.", field="full_well", hint="give at least 1 electron")
        if not (np.isfinite(self.read) and self.read >= 0):
            raise InputError(f"is {self.read}.", field="read", hint="give electrons >= 0")

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame with noisy colours."""
        scale = self.full_well / 255.0
        electrons = rng.poisson(scale * frame.rgb) + self.read * rng.standard_normal(frame.rgb.shape)
        return replace(frame, rgb=np.clip(np.rint(electrons / scale), 0, 255).astype(np.uint8))

"""Shot noise and read noise of colour images."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from splatbot.frame import Frame
from splatbot.sim.effects.base import SensorEffect, setting


@dataclass(frozen=True)
class ColorNoise(SensorEffect, cost="two random numbers for each pixel and channel", observable="colors"):
    """Simulated shot and read noise; depth is unchanged.

    The model is the linear one of EMVA Standard 1288: v' = (Poisson(k v) + σ_read ε) / k with ε ~ N(0, 1) and
    k = full_well / 255 electrons per 8-bit value. The camera's response curve is not modelled.

    Args:
        full_well: electrons at 255; small sensors hold a few thousand. Fewer electrons are noisier, as at a high gain.
        read: standard deviation σ_read [electrons] of the read noise.

    Raises:
        InputError: an argument is out of range.
    """

    full_well: float = setting(4000.0, "give at least 1 electron", low=1)
    read: float = setting(8.0, "give electrons >= 0", low=0)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Add noise to the colours."""
        scale = self.full_well / 255.0
        electrons = rng.poisson(scale * frame.rgb) + self.read * rng.standard_normal(frame.rgb.shape)
        return replace(frame, rgb=np.clip(np.rint(electrons / scale), 0, 255).astype(np.uint8))

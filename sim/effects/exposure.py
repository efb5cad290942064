"""Brightness that jumps or drifts, as when automatic exposure reacts or a lamp is switched on."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from splatbot.frame import Frame
from splatbot.sim.effects.base import SensorEffect, check_span, setting


@dataclass(frozen=True)
class Exposure(SensorEffect, cost="a table look-up", observable="colors"):
    """Simulated change of exposure: v' = clip(gain v + offset, 0, 255); depth is unchanged.

    The affine model is the one that photometric trackers fit (Engel, Koltun, Cremers 2018, section 2.1). It applies to
    8-bit values. The camera's response curve is not modelled.

    Args:
        step: gain from frame ``at`` on; 1 for none.
        offset: added to the values (0..255) from frame ``at`` on.
        at: first frame of the step.
        until: first frame after it; 0 for never.
        drift: doublings of the gain per second, from stamp 0 on; negative darkens.

    Raises:
        InputError: an argument is out of range.
    """

    step: float = setting(2.0, "give a finite gain >= 0", low=0)
    offset: float = setting(0.0)
    at: int = 0
    until: int = 0
    drift: float = setting(0.0)

    def __post_init__(self) -> None:
        super().__post_init__()
        check_span(self.at, self.until)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Change the brightness of the frame."""
        stepped = frame.index >= self.at and not (self.until and frame.index >= self.until)
        gain = float(2.0 ** np.clip(self.drift * frame.stamp, -64, 64)) * (self.step if stepped else 1.0)
        offset = self.offset if stepped else 0.0
        if gain == 1.0 and offset == 0.0:
            return frame
        table = np.clip(np.rint(gain * np.arange(256) + offset), 0, 255).astype(np.uint8)
        return replace(frame, rgb=table[frame.rgb])

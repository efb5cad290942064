"""Write a sensor effect, a coloured vignette, and apply it to a synthetic log."""

from dataclasses import dataclass, replace

import numpy as np

from splatbot import Frame, open_log
from splatbot.sim.effects.base import Effects, SensorEffect, setting


@dataclass(frozen=True)
class Vignette(SensorEffect, cost="one multiplication for each pixel and channel", observable="colors"):
    """Darkens the image with the squared distance from its centre, and adds a little noise."""

    strength: float = setting(0.5, "give a share in 0..1", low=0, high=1)
    noise: float = setting(1.0, "give grey levels >= 0", low=0)  # standard deviation [grey levels]

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Return the darkened frame; ``frame`` is not written to."""
        height, width = frame.rgb.shape[:2]
        v, u = np.mgrid[-1 : 1 : 1j * height, -1 : 1 : 1j * width]
        gain = 1.0 - self.strength * (u**2 + v**2) / 2.0
        rgb = gain[..., None] * frame.rgb + self.noise * rng.standard_normal(frame.rgb.shape)
        return replace(frame, rgb=np.clip(np.rint(rgb), 0, 255).astype(np.uint8))


log = open_log("synthetic:tabletop?frames=3&width=160&height=120")
effects = Effects([Vignette(strength=0.8, why="example")], seed=0)
for ideal, real in zip(log, effects.over(log), strict=True):
    corner, centre = (slice(0, 10), slice(0, 10)), (slice(55, 65), slice(75, 85))
    ratios = [real.rgb[at].mean() / ideal.rgb[at].mean() for at in (centre, corner)]
    print(f"frame {real.index}: centre x {ratios[0]:.2f}, corner x {ratios[1]:.2f}")
print(f"effects of this log: {[effect['name'] for effect in effects.report()]}")

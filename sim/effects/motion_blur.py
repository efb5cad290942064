"""Colour blur by camera motion during the exposure."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.frame import Frame
from splatbot.sim.effects.base import CameraMotionEffect, setting
from splatbot.sim.effects.warping import flow, grid, motion_during

_MIN_BLUR_PX = 0.1  # [px] below this no pixel changes


@dataclass(frozen=True)
class MotionBlur(CameraMotionEffect, cost="one warp for each pixel of blur, at most `samples`", observable="colors"):
    """Simulated motion blur: the mean of sub-exposures, each the frame warped by its own depth and the camera motion.

    Warping works for any source with a known camera path: a ray caster, the twin, or a recording with ground truth. It
    costs one warp per sub-exposure. The frame's stamp is the middle of the exposure.

    Limits: the warp is first order in the motion, and surfaces that an edge hides at the stamp take the colour of the
    edge. Pixels without depth count as infinitely far. Depth is unchanged, and moving objects are not blurred by their
    own motion. 8-bit values are averaged without the camera's response curve.

    Args:
        exposure: exposure time [s].
        samples: maximum number of sub-exposures; there are fewer if the longest blur [px] is shorter.

    Raises:
        InputError: an argument is out of range; on application, if the path is not known.
    """

    exposure: float = setting(0.02, "give seconds >= 0", low=0)
    samples: int = setting(32, "give at least 2", low=2)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Smear the colours of the frame."""
        ends = motion_during(self.known_path(), frame.stamp, self.exposure)
        flows = [flow(frame.camera, frame.depth, T_now_then) for T_now_then in ends]
        longest = float(np.abs(flows[0]).max() + np.abs(flows[1]).max())
        if longest < _MIN_BLUR_PX:
            return frame
        count = int(np.clip(np.ceil(longest) + 1, 2, self.samples))
        return replace(frame, rgb=_mean_along(frame.rgb, flows, count))


def _mean_along(rgb: NDArray[np.uint8], flows: list[NDArray[np.float32]], count: int) -> NDArray[np.uint8]:
    height, width = rgb.shape[:2]
    places = grid(height, width)
    total = np.zeros(rgb.shape, np.float32)
    for s in (np.arange(count) + 0.5) / count * 2 - 1:
        at = places + np.float32(abs(s)) * flows[int(s > 0)]
        total += cv2.remap(rgb, at[..., 0], at[..., 1], cv2.INTER_CUBIC, borderMode=cv2.BORDER_REPLICATE)
    return np.rint(total / count).astype(np.uint8)

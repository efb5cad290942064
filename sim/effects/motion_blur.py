"""Colours that smear because the camera moves while the shutter is open."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.sim.effects.base import Observable
from splatbot.sim.effects.warping import flow, grid, motion_during
from splatbot.trajectory import Trajectory

_STILL_PX = 0.1  # a smear that no pixel shows


@dataclass(frozen=True)
class MotionBlur:
    """The mean of sub-exposures, each the frame warped by where its own depth says the pixels would be.

    Warping instead of rendering every sub-exposure anew makes it work for any source that knows its path (a ray caster,
    the twin, a recording with ground truth), at the cost of one warp per sub-exposure. The frame's stamp is the middle
    of the exposure. The warp is right to first order in the motion; what a near edge hides at the stamp is smeared from
    the edge itself. Pixels without depth count as infinitely far. Depth is untouched, and objects that move on their
    own are not smeared by that. 8-bit values are averaged as they are, without a camera's response curve.

    Args:
        exposure: how long the shutter is open [s].
        samples: most sub-exposures; fewer where the longest smear [px] is shorter than that.
        why: who asked for it.
        path: how the camera moves.

    Raises:
        InputError: an argument is out of range; when applied: the path is not known.
    """

    exposure: float = 0.02
    samples: int = 32
    why: str = "asked for"
    name: str = "motion_blur"
    path: Trajectory | None = None
    cost: ClassVar[str] = "a warp for each pixel of smear, at most `samples`"
    observable: ClassVar[Observable] = "colors"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.exposure) and self.exposure >= 0):
            raise InputError(f"is {self.exposure}.", field="exposure", hint="give seconds >= 0")
        if self.samples < 2:
            raise InputError(f"is {self.samples}.", field="samples", hint="give at least 2")

    def along(self, path: Trajectory) -> MotionBlur:
        """The blur of a camera that moves along ``path``."""
        return replace(self, path=path)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame with smeared colours."""
        ends = motion_during(self.path, frame.stamp, self.exposure, effect=self.name)
        flows = [flow(frame.camera, frame.depth, T_now_then) for T_now_then in ends]
        longest = float(np.abs(flows[0]).max() + np.abs(flows[1]).max())
        if longest < _STILL_PX:
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

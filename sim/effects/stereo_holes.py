"""What a stereo camera cannot measure: the strip and the shadows that only one of its eyes sees."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.sim.effects.base import Observable

_SAME = 1.0  # [px] of disparity between a surface and itself
_LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601


@dataclass(frozen=True)
class StereoHoles:
    """Pixels without depth as a camera of two eyes leaves them, depth being that of the left one; colour is untouched.

    Where the right eye's image ends there is a strip along the left border, the "invalid depth band" of width
    B f / Z pixels, B / (2 Z tan(HFOV/2)) of the image (Intel RealSense D400 series datasheet 337029, section 4.5);
    beside near things lies a shadow of B f (1/near - 1/far) pixels. The rest fails at random. The defaults are a
    D435's: the baseline is its datasheet's; the share of the rest is an assumption, and so are the limits of darkness
    and glare, which are off unless given.

    Args:
        baseline: between the eyes [m].
        scatter: share of the other pixels that fail, 0..1.
        dark: pixels darker than this (0..255) fail: they give back too little light; 0 for none.
        bright: pixels at least this bright (0..255) fail: glare; 256 for none.
        why: who asked for it.

    Raises:
        InputError: an argument is out of range.
    """

    baseline: float = 0.05
    scatter: float = 0.01
    dark: int = 0
    bright: int = 256
    why: str = "asked for"
    name: str = "stereo_holes"
    cost: ClassVar[str] = "each pixel's place in the other eye, and a random number"
    observable: ClassVar[Observable] = "depth"

    def __post_init__(self) -> None:
        if not (np.isfinite(self.baseline) and self.baseline >= 0):
            raise InputError(f"is {self.baseline}.", field="baseline", hint="give metres >= 0")
        if not 0 <= self.scatter <= 1:
            raise InputError(f"is {self.scatter}.", field="scatter", hint="give a share in 0..1")
        for name in ("dark", "bright"):
            if not 0 <= getattr(self, name) <= 256:
                raise InputError(f"is {getattr(self, name)}.", field=name, hint="give a brightness in 0..256")

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame without the depth that such a camera does not get."""
        lost = _unseen(frame.depth, self.baseline * frame.camera.fx) | (rng.random(frame.depth.shape) < self.scatter)
        if self.dark > 0 or self.bright < 256:
            luma = frame.rgb @ _LUMA
            lost |= (luma < self.dark) | (luma >= self.bright)
        return replace(frame, depth=np.where(lost, np.float32(0), frame.depth))


def _unseen(depth: NDArray[np.float32], pull: float) -> NDArray[np.bool_]:
    """Pixels (H, W) that the right eye does not see; a point at depth z lies ``pull`` / z [px] farther left in it."""
    disparity = np.divide(pull, depth, out=np.zeros_like(depth), where=depth > 0)
    there = np.rint(np.arange(depth.shape[1], dtype=np.float32) - disparity).astype(np.int64)
    outside = there < 0
    rows = np.broadcast_to(np.arange(len(depth))[:, None], there.shape)
    nearest = np.zeros_like(depth)  # disparity of what the right eye sees
    np.maximum.at(nearest, (rows, np.maximum(there, 0)), np.where(outside, 0.0, disparity).astype(np.float32))
    nearest = np.asarray(cv2.dilate(nearest, np.ones((1, 3), np.uint8)))  # gaps of what it sees wider than the left
    hidden = nearest[rows, np.maximum(there, 0)] > disparity + _SAME + 1.0
    return np.asarray(outside | hidden)

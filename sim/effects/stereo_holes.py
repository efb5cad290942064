"""Missing depth of stereo cameras: the invalid depth band and the occlusions of the right camera."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.frame import Frame
from splatbot.sim.effects.base import SensorEffect, setting

_DISPARITY_TOLERANCE = 1.0  # [px] between a surface and itself
_LUMA = np.array([0.299, 0.587, 0.114], np.float32)  # ITU-R BT.601


@dataclass(frozen=True)
class StereoHoles(SensorEffect, cost="the disparity of each pixel, and a random number", observable="depth"):
    """Simulated missing depth of a stereo camera, in the left image; colour is unchanged.

    Depth is missing in three regions:

    - the "invalid depth band" at the left border, B f / Z pixels wide, or B / (2 Z tan(HFOV / 2)) of the width
      (Intel RealSense D400 datasheet 337029, section 4.5);
    - the occlusion next to a near object, B f (1 / Z_near - 1 / Z_far) pixels wide;
    - randomly chosen pixels.

    The default baseline is that of the D435's datasheet. The default of ``scatter`` is an assumption. Dark and bright
    pixels are kept by default.

    Args:
        baseline: distance B [m] between the two cameras.
        scatter: fraction of the other pixels that fail, 0..1.
        dark: pixels darker than this (0..255) fail for lack of light; 0 for none.
        bright: pixels at least this bright (0..255) fail by glare; 256 for none.

    Raises:
        InputError: an argument is out of range.
    """

    baseline: float = setting(0.05, "give metres >= 0", low=0)
    scatter: float = setting(0.01, "give a share in 0..1", low=0, high=1)
    dark: int = setting(0, "give a brightness in 0..256", low=0, high=256)
    bright: int = setting(256, "give a brightness in 0..256", low=0, high=256)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Remove the depth that a stereo camera cannot measure."""
        lost = _occluded(frame.depth, self.baseline * frame.camera.fx) | (rng.random(frame.depth.shape) < self.scatter)
        if self.dark > 0 or self.bright < 256:
            luma = frame.rgb @ _LUMA
            lost |= (luma < self.dark) | (luma >= self.bright)
        return replace(frame, depth=np.where(lost, np.float32(0), frame.depth))


def _occluded(depth: NDArray[np.float32], baseline_px: float) -> NDArray[np.bool_]:
    """Return the pixels (H, W) that the right camera cannot see; disparity [px] is ``baseline_px`` [m px] / depth."""
    disparity = np.divide(baseline_px, depth, out=np.zeros_like(depth), where=depth > 0)
    column = np.rint(np.arange(depth.shape[1], dtype=np.float32) - disparity).astype(np.int64)
    outside = column < 0
    rows = np.broadcast_to(np.arange(len(depth))[:, None], column.shape)
    nearest = np.zeros_like(depth)  # largest disparity at each pixel of the right image
    np.maximum.at(nearest, (rows, np.maximum(column, 0)), np.where(outside, 0.0, disparity).astype(np.float32))
    nearest = np.asarray(cv2.dilate(nearest, np.ones((1, 3), np.uint8)))  # closes gaps on surfaces that appear wider
    hidden = nearest[rows, np.maximum(column, 0)] > disparity + _DISPARITY_TOLERANCE + 1.0
    return np.asarray(outside | hidden)

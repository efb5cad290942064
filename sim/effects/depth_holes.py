"""Missing depth in blobs, as on dark, shiny or transparent objects."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.frame import Frame
from splatbot.sim.effects.base import SensorEffect, setting


@dataclass(frozen=True)
class DepthHoles(SensorEffect, cost="smooth noise, and a partial sort of the pixels", observable="depth"):
    """Simulated blobs without depth, different in every frame; colour is unchanged.

    Smooth noise is thresholded at the quantile ``share`` of the valid pixels, so each frame loses exactly that share.

    Args:
        share: of the pixels with depth that lose it, 0..1.
        size: typical width of a blob [px].

    Raises:
        InputError: an argument is out of range.
    """

    share: float = setting(0.4, "give a share in 0..1, 1 excluded", low=0, below=1)
    size: float = setting(40.0, "give at least 1 pixel", low=1)

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """Remove the depth inside the blobs."""
        valid = frame.valid
        lost = round(self.share * int(valid.sum()))
        if not lost:
            return frame
        noise = np.where(valid, self._smooth_noise(valid.shape, rng), np.inf).ravel()
        depth = frame.depth.copy()
        depth.reshape(-1)[np.argpartition(noise, lost - 1)[:lost]] = 0.0
        return replace(frame, depth=depth)

    def _smooth_noise(self, shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float32]:
        """Return noise (H, W) with blobs of width ``size``; a little fine noise makes their borders irregular."""
        coarse = [int(np.ceil(2 * n / self.size)) + 1 for n in shape]
        noise = cv2.resize(rng.standard_normal(coarse, np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC)
        return np.asarray(noise + 0.05 * rng.standard_normal(shape, np.float32), dtype=np.float32)

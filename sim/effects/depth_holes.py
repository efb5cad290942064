"""Depth that is missing in blobs, as on dark, shiny or transparent things."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import ClassVar

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.sim.effects.base import Observable


@dataclass(frozen=True)
class DepthHoles:
    """Blobs without depth, others in every frame; colour is untouched.

    Smooth noise is cut at the height that leaves out the asked-for share of the valid pixels, so each frame loses
    exactly that.

    Args:
        share: of the pixels with depth that lose it, 0..1.
        size: typical width of a blob [px].
        why: who asked for it.

    Raises:
        InputError: an argument is out of range.
    """

    share: float = 0.4
    size: float = 40.0
    why: str = "asked for"
    name: str = "depth_holes"
    cost: ClassVar[str] = "smooth noise, and a partial sort of the pixels"
    observable: ClassVar[Observable] = "depth"

    def __post_init__(self) -> None:
        if not 0 <= self.share < 1:
            raise InputError(f"is {self.share}.", field="share", hint="give a share in 0..1, 1 excluded")
        if not (np.isfinite(self.size) and self.size >= 1):
            raise InputError(f"is {self.size}.", field="size", hint="give at least 1 pixel")

    def apply(self, frame: Frame, rng: np.random.Generator) -> Frame:
        """The frame without the depth in the blobs."""
        valid = frame.valid
        lost = round(self.share * int(valid.sum()))
        if not lost:
            return frame
        noise = np.where(valid, self._smooth_noise(valid.shape, rng), np.inf).ravel()
        depth = frame.depth.copy()
        depth.reshape(-1)[np.argpartition(noise, lost - 1)[:lost]] = 0.0
        return replace(frame, depth=depth)

    def _smooth_noise(self, shape: tuple[int, ...], rng: np.random.Generator) -> NDArray[np.float32]:
        """Noise (H, W) with blobs of the size, and a little fine noise that frays their rims."""
        coarse = [int(np.ceil(2 * n / self.size)) + 1 for n in shape]
        noise = cv2.resize(rng.standard_normal(coarse, np.float32), shape[::-1], interpolation=cv2.INTER_CUBIC)
        return np.asarray(noise + 0.05 * rng.standard_normal(shape, np.float32), dtype=np.float32)

"""A keyframe's exposure against the map's: where it jumps, it is taken out before colours are fused."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatbot.mapping.insertion import ModelView

Image = NDArray[np.float64]

_BLOCK = 16  # [px] over whose side colours are averaged: the map's blur and noise would pass for contrast
_LEAST_BLOCKS = 20
_SOLID = 0.9  # alpha from which on the map shows colour
_AGREES = 0.05  # depths that differ by less are of the same surface [share of depth]
_CLIPPED = (2, 253)  # values beyond these say only that there was as little, or as much
_STEPS, _SCALE = 10, 0.02  # of the robust fit; residuals of this size still count half
# Smaller differences [0..1] stay. Automatic exposure makes up to 0.16 from keyframe to keyframe of recorded logs: there
# the map shows each place as it looked, and taken out each time, the map's own errors would add up.
_JUMP = 0.2


@dataclass(frozen=True)
class ExposureFit:
    """Colours of an image, 0..1, as ``gain`` times the map's plus ``offset`` (Engel, Koltun, Cremers 2018, 2.1)."""

    gain: float = 1.0
    offset: float = 0.0

    @property
    def is_jump(self) -> bool:
        """Whether black or white differs by more than automatic exposure makes of it between keyframes."""
        return max(abs(self.offset), abs(self.gain + self.offset - 1.0)) > _JUMP


def exposure_of(rgb: Tensor, depth: Tensor, view: ModelView) -> ExposureFit:
    """How an image is exposed against the map.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) [m], 0 missing: what the map shows of another surface is left out.
        view: the map from the same pose, of the same size.

    Neutral where the map shows too little of the image, or the fit is absurd.
    """
    seen = rgb.numpy()
    inside = cv2.inRange(seen, (_CLIPPED[0] + 1,) * 3, (_CLIPPED[1] - 1,) * 3) > 0
    there = depth.numpy() > 0
    same = np.abs(view.depth.numpy() - depth.numpy()) < _AGREES * depth.numpy()
    used = inside & there & same & (view.alpha.numpy() > _SOLID)
    of_map, of_image = _blocks(_gray(view.rgb.numpy()), used), _blocks(_gray(seen) / 255.0, used)
    full = np.isfinite(of_map)
    if full.sum() < _LEAST_BLOCKS:
        return ExposureFit()
    gain, offset = _robust_line(of_map[full], of_image[full])
    return ExposureFit(gain, offset) if 0.1 < gain < 10 else ExposureFit()


def in_exposure_of_map(rgb: Tensor, depth: Tensor, view: ModelView) -> Tensor:
    """The image (H, W, 3) uint8 as it would be in the map's exposure; itself where they differ by no jump.

    What was clipped is as bright, or as dark, as the map has it, if the map goes further.
    """
    exposure = exposure_of(rgb, depth, view)
    if not exposure.is_jump:
        return rgb
    seen = rgb.numpy()
    corrected = (seen / 255.0 - exposure.offset) / exposure.gain
    shown, solid = view.rgb.numpy(), (view.alpha.numpy() > _SOLID)[..., None]
    corrected = np.where(solid & (seen > _CLIPPED[1]), np.maximum(corrected, shown), corrected)
    corrected = np.where(solid & (seen < _CLIPPED[0]), np.minimum(corrected, shown), corrected)
    return torch.from_numpy(np.rint(255.0 * corrected.clip(0, 1)).astype(np.uint8))


def _gray(rgb: NDArray[np.generic]) -> NDArray[np.float32]:
    """Mean (H, W) over the channels."""
    return np.asarray(cv2.transform(np.asarray(rgb, dtype=np.float32), np.full((1, 3), 1 / 3)), dtype=np.float32)


def _blocks(image: NDArray[np.floating], used: NDArray[np.bool_]) -> Image:
    """Means over blocks of the pixels used, one row; NaN where less than half are."""
    height, width = (side // _BLOCK for side in image.shape)
    crop = (slice(height * _BLOCK), slice(width * _BLOCK))
    if not height or not width:
        return np.zeros(0)

    def mean(values: NDArray[np.floating]) -> Image:
        return np.asarray(cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA))

    share = mean(used[crop].astype(np.float64))
    total = mean(np.where(used, image, 0.0)[crop].astype(np.float64))
    return np.where(share >= 0.5, total / np.maximum(share, 0.5), np.nan).ravel()


def _robust_line(x: Image, y: Image) -> tuple[float, float]:
    """Slope and intercept of y over x, Cauchy weights; the intercept is drawn to 0, for one grey tells but a gain.

    Begins with the gain of the medians, so that things that are there no more do not mislead it.
    """
    gain, offset = float(np.median(y) / max(np.median(x), 1e-3)), 0.0
    A = np.stack([x, np.ones_like(x)], 1)
    for _ in range(_STEPS):
        weight = 1.0 / (1.0 + ((gain * x + offset - y) / _SCALE) ** 2)
        H = (A * weight[:, None]).T @ A + np.diag([0.0, 1e-3 * weight.sum()])
        gain, offset = (float(value) for value in np.linalg.solve(H, (A * weight[:, None]).T @ y))
    return gain, offset

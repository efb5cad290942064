"""Exposure of a keyframe relative to the map: large differences are corrected before colors are fused."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatbot.mapping.insertion import ModelView

Image = NDArray[np.float64]


@dataclass(frozen=True)
class ExposureConstants:
    """Constants of the exposure correction."""

    block_size: int = 16
    """Side [px] of the blocks whose mean colors are compared. Single pixels differ by blur and noise."""
    least_blocks: int = 20
    """Number of blocks [1] below which the exposure counts as unchanged. A smaller one lets noise of a few blocks
    determine it."""
    opaque_alpha: float = 0.9
    """Alpha [1] of the map above which its color is valid. A smaller one compares with the map's background."""
    depth_share: float = 0.05
    """Relative difference of depth [1] up to which map and image show the same surface. A larger one compares colors of
    different surfaces."""
    unclipped: tuple[int, int] = (2, 253)
    """Range [0..255] of a channel that is not clipped to black or white."""
    fit_iterations: int = 10
    """Number of iterations [1] of the robust fit."""
    fit_scale: float = 0.02
    """Residual [0..1] that has half the weight. A larger one lets surfaces that changed bias the fit."""
    offset_prior: float = 1e-3
    """Relative weight [1] of the prior that draws the offset to 0. A uniform gray determines only the gain."""
    gains: tuple[float, float] = (0.1, 10.0)
    """Range of the gain [1] of a plausible fit; outside of it, the exposure counts as unchanged."""
    correction_threshold: float = 0.2
    """Change of black or white [0..1] up to which differences remain. Automatic exposure changes by up to 0.16 between
    keyframes of recorded logs. Corrections of such differences would accumulate the map's own errors."""


CONSTANTS = ExposureConstants()


@dataclass(frozen=True)
class ExposureFit:
    """Affine brightness I = gain · M + offset of image I and map M, in 0..1 (Engel, Koltun, Cremers 2018, Sec. 2.1)."""

    gain: float = 1.0
    offset: float = 0.0

    @property
    def is_jump(self) -> bool:
        """True if black or white differs by more than automatic exposure changes between keyframes."""
        return max(abs(self.offset), abs(self.gain + self.offset - 1.0)) > CONSTANTS.correction_threshold


def exposure_of(rgb: Tensor, depth: Tensor, view: ModelView) -> ExposureFit:
    """Estimate the exposure of an image relative to the map.

    The result is neutral if the map covers too little of the image, or if the fit is implausible.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) [m], 0 missing; pixels where the map shows another surface are excluded.
        view: the map rendered from the same pose, at the same size.
    """
    seen, (black, white) = rgb.numpy(), CONSTANTS.unclipped
    inside = cv2.inRange(seen, (black + 1,) * 3, (white - 1,) * 3) > 0
    measured = depth.numpy() > 0
    same = np.abs(view.depth.numpy() - depth.numpy()) < CONSTANTS.depth_share * depth.numpy()
    used = inside & measured & same & (view.alpha.numpy() > CONSTANTS.opaque_alpha)
    of_map, of_image = _blocks(_gray(view.rgb.numpy()), used), _blocks(_gray(seen) / 255.0, used)
    full = np.isfinite(of_map)
    if full.sum() < CONSTANTS.least_blocks:
        return ExposureFit()
    gain, offset = _robust_line(of_map[full], of_image[full])
    least, most = CONSTANTS.gains
    return ExposureFit(gain, offset) if least < gain < most else ExposureFit()


def in_exposure_of_map(rgb: Tensor, depth: Tensor, view: ModelView) -> Tensor:
    """Return the image (H, W, 3) uint8 in the map's exposure; the same image if the difference is small.

    A clipped pixel takes the map's value if that is brighter than white or darker than black.
    """
    exposure = exposure_of(rgb, depth, view)
    if not exposure.is_jump:
        return rgb
    seen, (black, white) = rgb.numpy(), CONSTANTS.unclipped
    corrected = (seen / 255.0 - exposure.offset) / exposure.gain
    shown, solid = view.rgb.numpy(), (view.alpha.numpy() > CONSTANTS.opaque_alpha)[..., None]
    corrected = np.where(solid & (seen > white), np.maximum(corrected, shown), corrected)
    corrected = np.where(solid & (seen < black), np.minimum(corrected, shown), corrected)
    return torch.from_numpy(np.rint(255.0 * corrected.clip(0, 1)).astype(np.uint8))


def _gray(rgb: NDArray[np.generic]) -> NDArray[np.float32]:
    """Compute the mean (H, W) over the channels."""
    return np.asarray(cv2.transform(np.asarray(rgb, dtype=np.float32), np.full((1, 3), 1 / 3)), dtype=np.float32)


def _blocks(image: NDArray[np.floating], used: NDArray[np.bool_]) -> Image:
    """Compute the means (B,) of the used pixels over blocks; NaN where less than half of a block is used."""
    height, width = (side // CONSTANTS.block_size for side in image.shape)
    crop = (slice(height * CONSTANTS.block_size), slice(width * CONSTANTS.block_size))
    if not height or not width:
        return np.zeros(0)

    def mean(values: NDArray[np.floating]) -> Image:
        return np.asarray(cv2.resize(values, (width, height), interpolation=cv2.INTER_AREA))

    share = mean(used[crop].astype(np.float64))
    total = mean(np.where(used, image, 0.0)[crop].astype(np.float64))
    return np.where(share >= 0.5, total / np.maximum(share, 0.5), np.nan).ravel()


def _robust_line(x: Image, y: Image) -> tuple[float, float]:
    """Fit gain and offset of y over x by iteratively reweighted least squares with Cauchy weights.

    w = 1 / (1 + (r / s)²). A weak prior draws the offset to 0, because a uniform gray determines only the gain. The
    fit starts with the ratio of the medians, which is robust against removed objects.
    """
    gain, offset = float(np.median(y) / max(np.median(x), 1e-3)), 0.0
    A = np.stack([x, np.ones_like(x)], 1)
    for _ in range(CONSTANTS.fit_iterations):
        weight = 1.0 / (1.0 + ((gain * x + offset - y) / CONSTANTS.fit_scale) ** 2)
        H = (A * weight[:, None]).T @ A + np.diag([0.0, CONSTANTS.offset_prior * weight.sum()])
        gain, offset = (float(value) for value in np.linalg.solve(H, (A * weight[:, None]).T @ y))
    return gain, offset

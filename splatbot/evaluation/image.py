"""Errors of a rendered image against a photograph: PSNR and SSIM."""

from __future__ import annotations

import math

import cv2
import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError

_WINDOW, _SIGMA = 11, 1.5
_C1, _C2 = 0.01**2, 0.03**2


def psnr(image: ArrayLike, reference: ArrayLike) -> float:
    """Compute the peak signal-to-noise ratio -10 log10(MSE) [dB] of two images; equal images give infinity.

    Args:
        image: uint8, or float in 0..1.
        reference: of the same shape; uint8, or float in 0..1.

    Raises:
        InputError: the shapes differ, or a type is neither uint8 nor float.
    """
    a, b = _pair(image, reference)
    mse = float(np.mean((a - b) ** 2))
    return math.inf if mse == 0.0 else -10.0 * math.log10(mse)


def ssim(image: ArrayLike, reference: ArrayLike) -> float:
    """Compute the structural similarity of images (H, W[, C]), uint8 or float in 0..1 (Wang et al. 2004).

    The Gaussian window has 11 x 11 pixels and σ = 1.5 pixels. The mean is over all windows inside the image and all
    channels.

    Raises:
        InputError: the shapes differ, a type is neither uint8 nor float, or the image is smaller than the window.
    """
    a, b = _pair(image, reference)
    if min(a.shape[:2]) < _WINDOW:
        raise InputError(f"is {a.shape[:2]}.", field="image", hint=f"SSIM needs {_WINDOW} pixels each way")
    mean_a, mean_b = _blur(a), _blur(b)
    var_a, var_b = _blur(a * a) - mean_a**2, _blur(b * b) - mean_b**2
    covariance = _blur(a * b) - mean_a * mean_b
    luminance = (2 * mean_a * mean_b + _C1) / (mean_a**2 + mean_b**2 + _C1)
    structure = (2 * covariance + _C2) / (var_a + var_b + _C2)
    return float(np.mean(luminance * structure))


def _pair(image: ArrayLike, reference: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    a, b = _unit(image), _unit(reference)
    if a.shape != b.shape or a.size == 0:
        raise InputError(f"is {a.shape}, the reference {b.shape}.", field="image", hint="compare images of one size")
    return a, b


def _unit(image: ArrayLike) -> NDArray[np.float64]:
    array = np.asarray(image)
    if array.dtype == np.uint8:
        return array.astype(np.float64) / 255.0
    if not np.issubdtype(array.dtype, np.floating):
        raise InputError(f"is {array.dtype}.", field="image", hint="give uint8 in 0..255 or float in 0..1")
    return array.astype(np.float64)


def _blur(image: NDArray[np.float64]) -> NDArray[np.float64]:
    margin = _WINDOW // 2
    blurred = np.asarray(cv2.GaussianBlur(image, (_WINDOW, _WINDOW), _SIGMA), dtype=np.float64)
    return blurred[margin:-margin, margin:-margin]

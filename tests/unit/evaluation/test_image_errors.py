"""PSNR and SSIM against closed forms and a direct sum over windows."""

from __future__ import annotations

import math

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.evaluation import psnr, ssim


def test_psnr_of_a_constant_offset_is_its_closed_form() -> None:
    a = np.full((20, 30, 3), 0.5)
    assert psnr(a + 0.1, a) == pytest.approx(20.0, abs=1e-12)
    assert psnr(np.full((5, 5), 100, np.uint8), np.full((5, 5), 110, np.uint8)) == pytest.approx(
        20 * math.log10(25.5), abs=1e-12
    )


def test_psnr_of_equal_images_is_infinite() -> None:
    assert psnr(np.ones((4, 4, 3), np.uint8), np.ones((4, 4, 3), np.uint8)) == math.inf


def test_uint8_and_float_images_may_be_mixed(rng: np.random.Generator) -> None:
    a, b = rng.integers(0, 256, (2, 16, 16, 3), dtype=np.uint8)
    assert psnr(a, b / 255.0) == pytest.approx(psnr(a, b), abs=1e-12)
    assert ssim(a, b / 255.0) == pytest.approx(ssim(a, b), abs=1e-12)


def direct_ssim(a: np.ndarray, b: np.ndarray) -> float:
    """Compute SSIM window by window (Wang et al. 2004, equations 13 to 15)."""
    x = np.arange(11) - 5
    w = np.exp(-(x[:, None] ** 2 + x[None, :] ** 2) / (2 * 1.5**2))
    w /= w.sum()
    values = []
    for i in range(a.shape[0] - 10):
        for j in range(a.shape[1] - 10):
            p, q = a[i : i + 11, j : j + 11], b[i : i + 11, j : j + 11]
            mp, mq = (w * p).sum(), (w * q).sum()
            vp, vq, c = (w * (p - mp) ** 2).sum(), (w * (q - mq) ** 2).sum(), (w * (p - mp) * (q - mq)).sum()
            values.append((2 * mp * mq + 1e-4) * (2 * c + 9e-4) / ((mp**2 + mq**2 + 1e-4) * (vp + vq + 9e-4)))
    return float(np.mean(values))


def test_ssim_equals_the_sum_over_windows(rng: np.random.Generator) -> None:
    a = rng.random((24, 19, 3))
    b = np.clip(a + 0.2 * rng.normal(size=a.shape), 0, 1)
    expected = np.mean([direct_ssim(a[..., c], b[..., c]) for c in range(3)])
    assert ssim(a, b) == pytest.approx(expected, abs=1e-12)
    assert ssim(a[..., 0], b[..., 0]) == pytest.approx(direct_ssim(a[..., 0], b[..., 0]), abs=1e-12)


def test_ssim_of_equal_images_is_one_and_symmetric(rng: np.random.Generator) -> None:
    a, b = rng.random((2, 16, 16, 3))
    assert ssim(a, a) == pytest.approx(1.0, abs=1e-12)
    assert ssim(a, b) == pytest.approx(ssim(b, a), abs=1e-14)


def test_images_that_cannot_be_compared_are_refused() -> None:
    with pytest.raises(InputError, match="one size"):
        psnr(np.zeros((4, 4)), np.zeros((4, 5)))
    with pytest.raises(InputError, match="int64"):
        psnr(np.zeros((4, 4), np.int64), np.zeros((4, 4)))
    with pytest.raises(InputError, match="11 pixels"):
        ssim(np.zeros((10, 40)), np.zeros((10, 40)))

"""Errors of a rendered depth image against a measured one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from splatbot.errors import InputError


@dataclass(frozen=True)
class DepthError:
    """Absolute difference of two depth images over the pixels that are valid in both.

    Args:
        l1: mean [m], or None if the images share no valid pixel.
        median: [m], or None if the images share no valid pixel.
        coverage: fraction of the reference's valid pixels that the image covers, 0..1. If None, the reference has none.
    """

    l1: float | None
    median: float | None
    coverage: float | None


def depth_error(depth: ArrayLike, reference: ArrayLike) -> DepthError:
    """Compare two depth images (H, W) [m]; 0, NaN and infinity mean missing depth.

    Raises:
        InputError: the shapes differ.
    """
    a, b = np.asarray(depth, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    if a.shape != b.shape:
        raise InputError(f"is {a.shape}, the reference {b.shape}.", field="depth", hint="compare images of one size")
    has_a, has_b = (np.isfinite(x) & (x > 0) for x in (a, b))
    both = has_a & has_b
    n_reference, n_shared = int(has_b.sum()), int(both.sum())
    coverage = n_shared / n_reference if n_reference else None
    if not n_shared:
        return DepthError(None, None, coverage)
    difference = np.abs(a[both] - b[both])
    return DepthError(float(difference.mean()), float(np.median(difference)), coverage)

"""How near a rendered depth image is to a measured one."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from splatbot.errors import InputError


@dataclass(frozen=True)
class DepthError:
    """Absolute difference of two depth images over the pixels that both have.

    Args:
        l1: mean [m]; None where the two share no pixel.
        median: [m]; None likewise.
        coverage: share of the reference's pixels that the image has, 0..1; None where the reference has none.
    """

    l1: float | None
    median: float | None
    coverage: float | None


def depth_error(depth: ArrayLike, reference: ArrayLike) -> DepthError:
    """Compare depth images (H, W) [m]; 0, NaN and infinity are missing.

    Raises:
        InputError: the shapes differ.
    """
    a, b = np.asarray(depth, dtype=np.float64), np.asarray(reference, dtype=np.float64)
    if a.shape != b.shape:
        raise InputError(f"is {a.shape}, the reference {b.shape}.", field="depth", hint="compare images of one size")
    has_a, has_b = (np.isfinite(x) & (x > 0) for x in (a, b))
    both = has_a & has_b
    wanted, shared = int(has_b.sum()), int(both.sum())
    coverage = shared / wanted if wanted else None
    if not shared:
        return DepthError(None, None, coverage)
    difference = np.abs(a[both] - b[both])
    return DepthError(float(difference.mean()), float(np.median(difference)), coverage)

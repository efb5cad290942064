"""Gauss-Newton alignment of a frame to keyframes: the loop that the geometric and the direct stage share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot import _native
from splatbot.geometry import inverse, se3_exp
from splatbot.tracking.prepare import Level
from splatbot.tracking.reference import Reference

Array = NDArray[np.float64]


@dataclass(frozen=True)
class Alignment:
    """Result of an alignment.

    Args:
        T_world_camera: (4, 4).
        information: (6, 6) of the twist (t [m], ω [rad]) that left-multiplies T_camera_world; exposure marginalised.
        overlap: share of the reference points that land in the image.
        inliers: share of the residuals below 3 σ.
        chi: median |residual| / σ over its expectation (0.6745): 1 when the noise model holds.
        cost: robust cost per reference point; points outside the image count as outliers.
    """

    T_world_camera: Array
    information: Array
    overlap: float
    inliers: float
    chi: float
    cost: float

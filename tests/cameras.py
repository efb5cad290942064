"""Projectors of the float64 reference for cameras other than the plain pinhole."""

from __future__ import annotations

from collections.abc import Sequence
from functools import partial

import torch
from torch import Tensor

from splatbot.rasterize.cameras import pinhole_limit
from splatbot.rasterize.reference import Projector
from splatbot.rasterize.reference_cameras import (
    affine_projector,
    fisheye_points,
    ortho_points,
    pinhole_points,
    unscented_projector,
)

NEAR = 0.01
AFFINE = {"ortho": affine_projector(ortho_points), "fisheye": affine_projector(fisheye_points)}


def before(points: Tensor) -> Tensor:
    """Return True for points in front of the near plane."""
    return points[..., 2] >= NEAR


def distorted_pinhole(coefficients: Sequence[float]) -> Projector:
    """Return the unscented projector of a pinhole with the distortion k1..k6, p1, p2, s1..s4."""
    exact = torch.tensor(coefficients).double()  # of the float32 numbers that the kernels take
    limit = pinhole_limit(exact[:6].numpy())

    def seen(points: Tensor) -> Tensor:
        inside = points[..., 0] ** 2 + points[..., 1] ** 2 < (limit * points[..., 2]) ** 2
        return before(points) & inside

    return unscented_projector(partial(pinhole_points, coefficients=exact), seen=seen)

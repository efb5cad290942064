"""Surfels: Gaussians without thickness, as discs of 2D Gaussian splatting (Huang et al. 2024).

A surfel is a Gaussian whose third standard deviation is ``SCALE_MIN``, which a model holds in place of 0. So a map of
surfels is a map of Gaussians for every reader, and its file needs no further field.
"""

from __future__ import annotations

import math
from dataclasses import replace

import torch
from torch import Tensor

from splatbot.gaussians.model import SCALE_MIN, GaussianModel

_LOG_THICKNESS = math.log(SCALE_MIN)
_ROUNDING = 1e-3  # of the logarithm, in files of other programs
# Turns about (1, 1, 1) that make the first, second or third axis the third one.
_TURNS = ((0.5, 0.5, 0.5, 0.5), (0.5, -0.5, -0.5, -0.5), (1.0, 0.0, 0.0, 0.0))


def holds_surfels(model: GaussianModel) -> bool:
    """Return whether a map has Gaussians, and each of them is a surfel."""
    return len(model) > 0 and bool((model.log_scales[:, 2] <= _LOG_THICKNESS + _ROUNDING).all())


def as_surfels(model: GaussianModel) -> GaussianModel:
    """Return the discs of Gaussians: the shortest axis becomes the third, and loses its thickness.

    A surfel keeps its bits.
    """
    if holds_surfels(model):
        return model
    shortest = model.log_scales.argmin(1)
    axes = (shortest[:, None] + torch.tensor([1, 2, 3])) % 3
    quats = _product(model.quats, torch.tensor(_TURNS)[shortest])
    turned = replace(model.clone(), quats=quats, log_scales=model.log_scales.gather(1, axes))
    flatten(turned)
    return turned


def flatten(model: GaussianModel) -> None:
    """Set the thickness of all Gaussians to that of a surfel, in place."""
    model.log_scales[:, 2] = _LOG_THICKNESS


def _product(a: Tensor, b: Tensor) -> Tensor:
    """Return the Hamilton products (N, 4) of quaternions wxyz."""
    w, v, x, u = a[:, :1], a[:, 1:], b[:, :1], b[:, 1:]
    return torch.cat([w * x - (v * u).sum(1, keepdim=True), w * u + x * v + torch.linalg.cross(v, u)], 1)

"""Losses that draw surfels to one surface (Huang et al. 2024, Sec. 4.2)."""

from __future__ import annotations

from dataclasses import dataclass

import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.optimize.losses import masked_mean, normal_consistency
from splatbot.rasterize.maps import MapRender
from splatbot.training.options import TrainingOptions


@dataclass(frozen=True)
class SurfaceLossConstants:
    """Constants of the losses; those of Huang et al. 2024 for a run of 30,000 steps.

    Args:
        normal_start: share of the run after which normals count, when depth has a shape.
        distortion_start: share of the run after which the distortion counts.
    """

    normal_start: float = 7 / 30
    distortion_start: float = 3 / 30


CONSTANTS = SurfaceLossConstants()


@dataclass(frozen=True)
class SurfaceWeights:
    """Weights of the losses of a step.

    Args:
        normal: of the normal consistency.
        distortion: of the distortion [1/m].
    """

    normal: float = 0.0
    distortion: float = 0.0

    @classmethod
    def at(cls, options: TrainingOptions, progress: float, extent: float) -> SurfaceWeights:
        """Return the weights at a share of the run, 0 to 1, in a scene of an extent [m]; 0 without surfels."""
        if not options.surfels:
            return cls()
        return cls(
            options.normal_weight if progress >= CONSTANTS.normal_start else 0.0,
            options.distortion_weight / extent if progress >= CONSTANTS.distortion_start else 0.0,
        )


def surface_loss(render: MapRender, weights: SurfaceWeights, trained: Tensor | None) -> Tensor:
    """Return w_n mean (1 - nᵀ N α) + w_d mean distortion, over the pixels that are trained on.

    Args:
        render: of surfels; with depth if normals count, and with the distortion if that counts.
        weights: of the two terms.
        trained: (H, W) bool, or None for all pixels.
    """
    loss = torch.zeros(())
    images = render.surfels
    if images is None:
        raise InputError("is of 3D Gaussians.", field="render", hint="render surfels")
    if weights.normal > 0 and images.depth_normals is not None:
        loss = loss + weights.normal * normal_consistency(images.normals, images.depth_normals, render.alpha, trained)
    if weights.distortion > 0 and images.distortion is not None:
        loss = loss + weights.distortion * masked_mean(images.distortion[..., 0], trained)
    return loss

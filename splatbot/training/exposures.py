"""Exposure compensation: an affine colour transform of the map for each photograph."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from splatbot.optimize.adam import adam_step


class ExposureTransforms:
    """Transforms c ↦ A c + b of the map's colours to those of each of C photographs, all estimated by Adam.

    A colour change M of the map leaves all renders as they are if each transform undoes it. The mean transform is
    therefore constrained to the identity: (1/C) Σ A = I and (1/C) Σ b = 0. A step adds Adam's increments less their
    mean over the photographs.

    Each photograph counts its own steps of Adam, with the rates of the release of 3D Gaussian splatting (Kerbl et al.
    2024). There, Adam steps all photographs at once, mostly with a gradient of 0. A view then moves about √C times as
    far, which follows its errors into colours that other views do not have.

    Args:
        count: C, the number of photographs.
    """

    def __init__(self, count: int) -> None:
        self.transforms = torch.eye(3, 4, dtype=torch.float64).repeat(count, 1, 1)
        """(C, 3, 4) float64, [A | b] each."""
        self.first = torch.zeros(count, 3, 4)
        self.second = torch.zeros(count, 3, 4)
        self.steps = torch.zeros(count)

    def step(self, views: list[int], gradients: Tensor, rate: float) -> None:
        """Perform one step.

        Args:
            views: indices of the B photographs of the step; one may be there twice.
            gradients: (B, 3, 4) of the loss to their transforms.
            rate: of each value.
        """
        increments = torch.zeros_like(self.first)
        seen = torch.zeros(len(self.steps), dtype=torch.bool)
        seen[views] = True
        adam_step(
            {"exposure": increments},
            {"exposure": torch.zeros_like(self.first).index_add_(0, torch.tensor(views), gradients.float())},
            {"exposure": self.first},
            {"exposure": self.second},
            self.steps,
            seen,
            {"exposure": rate},
            betas=(0.9, 0.999),
            eps=1e-8,
        )
        moves = increments.double()
        self.transforms = self.transforms + moves - moves.mean(0)


def exposed(render: Tensor, alpha: Tensor, background: Tensor, transform: Tensor) -> Tensor:
    """Return a render (H, W, 3) as a photograph of another exposure shows it; the background keeps its colour.

    With the map's part m = c - (1 - α) B of a pixel, the result is A m + α b + (1 - α) B. It is A c + b where the map
    is opaque.

    Args:
        render: c, (H, W, 3).
        alpha: α, (H, W, 1).
        background: B, (3,).
        transform: [A | b], (3, 4).
    """
    behind = (1 - alpha) * background
    return torch.cat([render - behind, alpha], dim=-1) @ transform.T.to(render.dtype) + behind


def fitted_exposure(render: Tensor, alpha: Tensor, background: Tensor, image: Tensor, counted: Tensor) -> Tensor:
    """Return the transform (3, 4) of least squares that :func:`exposed` needs to show a photograph.

    Args:
        render: (H, W, 3).
        alpha: (H, W, 1).
        background: (3,).
        image: (H, W, 3), the photograph in front of the same background.
        counted: (H, W) bool, pixels that count.
    """
    behind = (1 - alpha) * background
    parts, wanted = torch.cat([render - behind, alpha], dim=-1)[counted], (image - behind)[counted]
    found, *_ = np.linalg.lstsq(parts.double().numpy(), wanted.double().numpy(), rcond=None)
    return torch.from_numpy(found.T)

"""Densification: a Gaussian with a large positional gradient cannot represent its image area and is split in two."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import rotations

_SPLIT_OFFSET = 0.75  # distance of a half's center from that of the whole [σ of the longest axis]


class PositionGradients:
    """Mean norm of the loss gradient with respect to each projected center (Kerbl et al. 2023, Sec. 5.2).

    Coordinates are normalized to an image width of 2, as in that paper, so that the image size does not matter.
    """

    def __init__(self, count: int) -> None:
        self._sum, self._steps = torch.zeros(count), torch.zeros(count)

    def add(self, rows: Tensor, gradients: Tensor, width: int) -> None:
        """Add the gradients (M, 2) [1/px] of the centers of ``rows`` (M,) in an image ``width`` pixels wide."""
        self._sum.index_add_(0, rows, gradients.norm(dim=1).nan_to_num(0.0, 0.0, 0.0) * (width / 2))
        self._steps.index_add_(0, rows, torch.ones(len(rows)))

    def largest(self, limit: float, most: int) -> Tensor:
        """Return the rows, ascending, of the largest mean gradients above ``limit``, at most ``most`` of them."""
        mean = self._sum / self._steps.clamp_min(1.0)
        above = int((mean > limit).sum())
        return mean.topk(max(0, min(above, most))).indices.sort().values


def split(model: GaussianModel, rows: Tensor) -> GaussianModel:
    """Return the model with each of ``rows`` (M,) split in two across its longest axis; second halves are appended.

    Two equal Gaussians at μ ± δ with σ'² = σ² - δ² have the mean and covariance of the original. The surface does not
    move, and both inherit its observations and uncertainty.
    """
    axis = model.log_scales[rows].argmax(1)
    along = rotations(model.select(rows))[torch.arange(len(rows)), :, axis]
    offset = _SPLIT_OFFSET * model.log_scales[rows, axis].exp()[:, None] * along
    halved = model.clone()
    halved.log_scales[rows, axis] += 0.5 * math.log(1 - _SPLIT_OFFSET**2)
    second = halved.select(rows)
    halved.means[rows] -= offset
    second.means += offset
    return GaussianModel.concatenate([halved, second])

"""Densification: where pictures pull at a Gaussian's centre it shows more than it can, and becomes two."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import rotations

_OFF = 0.75  # of σ along the longest axis, by which each half's centre is off the whole's


class PositionGradients:
    """Mean length of the loss's gradient by each centre in the picture, over steps (Kerbl et al. 2023, §5.2).

    It is of coordinates in which a picture is 2 wide, as theirs is, so that its size does not matter.
    """

    def __init__(self, count: int) -> None:
        self._sum, self._steps = torch.zeros(count), torch.zeros(count)

    def add(self, rows: Tensor, gradients: Tensor, width: int) -> None:
        """One step: gradients (M, 2) [1/px] of the centres of ``rows`` (M,) in a picture ``width`` pixels wide."""
        self._sum.index_add_(0, rows, gradients.norm(dim=1).nan_to_num(0.0, 0.0, 0.0) * (width / 2))
        self._steps.index_add_(0, rows, torch.ones(len(rows)))

    def largest(self, limit: float, most: int) -> Tensor:
        """Rows, ascending, of those beyond ``limit``: the ``most`` that are pulled hardest."""
        mean = self._sum / self._steps.clamp_min(1.0)
        beyond = int((mean > limit).sum())
        return mean.topk(max(0, min(beyond, most))).indices.sort().values


def split(model: GaussianModel, rows: Tensor) -> GaussianModel:
    """The model with each of ``rows`` (M,) cut in two across its longest axis; second halves are appended.

    Two equal Gaussians at ±δ with σ'² = σ² - δ² have the mean and the covariance of the one: the surface stays where it
    is, and what was measured of it holds for both.
    """
    axis = model.log_scales[rows].argmax(1)
    along = rotations(model.select(rows))[torch.arange(len(rows)), :, axis]
    offset = _OFF * model.log_scales[rows, axis].exp()[:, None] * along
    halved = model.clone()
    halved.log_scales[rows, axis] += 0.5 * math.log(1 - _OFF**2)
    second = halved.select(rows)
    halved.means[rows] -= offset
    second.means += offset
    return GaussianModel.concatenate([halved, second])

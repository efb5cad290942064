"""Pruning: selection of the Gaussians that stay in the map."""

from __future__ import annotations

import torch
from torch import Tensor

from splatbot.config import MappingConfig
from splatbot.gaussians import GaussianModel


def keep_mask(model: GaussianModel, config: MappingConfig) -> Tensor:
    """Return the mask (N,) of finite Gaussians that are opaque and small enough."""
    finite = torch.isfinite(model.means).all(1) & torch.isfinite(model.log_scales).all(1)
    finite &= torch.isfinite(model.quats).all(1) & torch.isfinite(model.opacity_logits)
    finite &= torch.isfinite(model.sh).flatten(1).all(1)
    sane = model.scales.amax(1) < config.max_scale
    return finite & sane & (model.opacities > config.min_opacity)


def best_supported(model: GaussianModel, count: int) -> Tensor:
    """Return the rows, ascending, of the ``count`` Gaussians with the most observations, then the highest opacity."""
    merit = model.observations.float() + model.opacities
    return torch.argsort(merit, descending=True, stable=True)[:count].sort().values

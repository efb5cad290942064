"""Median depth: that of the Gaussian at which a pixel's transmittance falls to one half."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def median_ids(states: tuple[Any, ...], height: int, width: int) -> Tensor:
    """Per view, the Gaussian (C, H, W) int32 at which transmittance falls to 1/2 or below; -1 where it stays above."""
    ids = torch.empty(len(states), height, width, dtype=torch.int32)
    for i, state in enumerate(states):
        state.medians(ids[i].numpy())
    return ids


def depth_of(ids: Tensor, means: Tensor, viewmats: Tensor) -> Tensor:
    """Depths (C, H, W, 1) [m] of the Gaussians' centres, 0 where there is none; float32.

    Differentiable in means and poses: the choice of the Gaussian is taken as given.

    Args:
        ids: (C, H, W), see :func:`median_ids`.
        means: (N, 3), or (C, N, 3) [m], world frame.
        viewmats: (C, 4, 4) world to camera.
    """
    depths = []
    for i, view in enumerate(ids):
        found = view >= 0
        points = means[i] if means.ndim == 3 else means
        chosen = points.index_select(0, view[found].long()).double()
        z = chosen @ viewmats[i, 2, :3].double() + viewmats[i, 2, 3].double()
        depths.append(torch.zeros(view.shape, dtype=torch.float64).masked_scatter(found, z))
    if not depths:
        return torch.zeros(*ids.shape, 1)
    return torch.stack(depths)[..., None].to(torch.float32)

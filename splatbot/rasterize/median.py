"""Median depth: that of the Gaussian at which a pixel's transmittance falls to one half."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor


def median_ids(states: tuple[Any, ...], height: int, width: int) -> Tensor:
    """Return the Gaussian (C, H, W) int32 at which transmittance falls to 1/2 or below; -1 if it stays above."""
    ids = torch.empty(len(states), height, width, dtype=torch.int32)
    for i, state in enumerate(states):
        state.medians(ids[i].numpy())
    return ids


def median_depth(ids: Tensor, means: Tensor, viewmats: Tensor) -> Tensor:
    """Return the depths (V, H, W, 1) [m] of the Gaussians' centres, float32, 0 without a Gaussian.

    Differentiable in means and poses: the choice of the Gaussian is taken as given.

    Args:
        ids: (V, H, W) of V = B C views, see :func:`median_ids`.
        means: (B, N, 3) [m], world frame; of C views each.
        viewmats: (V, 4, 4) world to camera.
    """
    cameras = len(ids) // max(len(means), 1)
    images = []
    for i, view in enumerate(ids):
        found = view >= 0
        points = means[i // cameras].index_select(0, view[found].long()).double()
        z = points @ viewmats[i, 2, :3].double() + viewmats[i, 2, 3].double()
        images.append(torch.zeros(view.shape, dtype=torch.float64).masked_scatter(found, z))
    return torch.stack(images)[..., None].to(torch.float32) if images else torch.zeros(*ids.shape, 1)

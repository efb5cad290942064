"""What refinement minimises."""

from __future__ import annotations

import torch
from torch import Tensor


def l1(rendered: Tensor, observed: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean absolute difference, over ``mask`` (broadcast over channels) where given; 0 for an empty mask."""
    difference = (rendered - observed).abs()
    if mask is None:
        return difference.mean()
    return (difference * mask).sum() / mask.expand_as(difference).sum().clamp_min(1)


@torch.no_grad()
def exposure_match(rendered: Tensor, observed: Tensor, mask: Tensor) -> tuple[Tensor, Tensor]:
    """Gain and offset, one pair for all channels, that bring a rendering (H, W, 3) nearest to an image (least squares).

    A robot camera's exposure changes while it moves; without this the change would be painted into the map. Gain is
    kept within 0.5..2.
    """
    x, y = rendered[mask].flatten(), observed[mask].flatten()
    if len(x) < 100:
        return torch.ones(()), torch.zeros(())
    mx, my = x.mean(), y.mean()
    variance = ((x - mx) ** 2).mean()
    gain = (((x - mx) * (y - my)).mean() + 1e-3) / (variance + 1e-3)
    gain = gain.clamp(0.5, 2.0)
    return gain, my - gain * mx

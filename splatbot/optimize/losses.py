"""What refinement minimises."""

from __future__ import annotations

from torch import Tensor


def l1(rendered: Tensor, observed: Tensor, mask: Tensor | None = None) -> Tensor:
    """Mean absolute difference, over ``mask`` (broadcast over channels) where given; 0 for an empty mask."""
    difference = (rendered - observed).abs()
    if mask is None:
        return difference.mean()
    return (difference * mask).sum() / mask.expand_as(difference).sum().clamp_min(1)

"""Front-to-back order for any range of depths: the sort adapts the number of passes and the digit width."""

from __future__ import annotations

import pytest
import torch

from splatbot.rasterize import Gaussians, Viewpoints, contributing_gaussians

SIDE = 32


@pytest.mark.parametrize(
    ("count", "nearest", "farthest"),
    [
        pytest.param(40_000, 1.0, 1.0, id="all at one depth"),
        pytest.param(40_000, 1.0, 1.00001, id="a few bits"),
        pytest.param(40_000, 1.0, 1.9, id="22 bits"),
        pytest.param(40_000, 0.2, 20.0, id="26 bits"),
        pytest.param(40_000, 0.02, 2e4, id="more than 26 bits"),
        pytest.param(3_000, 0.2, 20.0, id="26 bits of few Gaussians"),
        pytest.param(300_000, 0.2, 20.0, id="26 bits of many Gaussians"),
    ],
)
def test_gaussians_are_met_front_to_back_and_in_order_of_index_at_one_depth(
    count: int, nearest: float, farthest: float
) -> None:
    generator = torch.Generator().manual_seed(3)
    z = nearest * (farthest / nearest) ** torch.rand(count, generator=generator)
    at = SIDE * torch.rand(count, 2, generator=generator)  # [px]
    means = torch.cat([(at - SIDE / 2) / SIDE * z[:, None], z[:, None]], -1)
    scales = (0.05 / SIDE * z)[:, None].expand(-1, 3).contiguous()
    quats = torch.tensor([1.0, 0.0, 0.0, 0.0]).expand(count, -1).contiguous()
    K = torch.tensor([[[SIDE, 0.0, SIDE / 2], [0.0, SIDE, SIDE / 2], [0.0, 0.0, 1.0]]])
    pixels = torch.cartesian_prod(torch.arange(SIDE), torch.arange(SIDE))
    gaussians = Gaussians(means, quats, scales, torch.full((count,), 0.1))
    found = contributing_gaussians(gaussians, Viewpoints(torch.eye(4)[None], K, SIDE, SIDE), pixels, k=16)
    ids = found.ids[0]
    both = (ids[:, :-1] >= 0) & (ids[:, 1:] >= 0)
    assert int(both.sum()) > 5 * len(pixels)
    first, second = ids[:, :-1][both], ids[:, 1:][both]
    assert bool(((z[first] < z[second]) | ((z[first] == z[second]) & (first < second))).all())

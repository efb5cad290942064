"""Losses against numpy in float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatbot.optimize.losses import l1


def images(rng: np.random.Generator) -> tuple[torch.Tensor, torch.Tensor]:
    a, b = rng.uniform(0, 1, (2, 13, 17, 3)).astype(np.float32)
    return torch.from_numpy(a), torch.from_numpy(b)


def test_l1_is_the_mean_absolute_difference(rng: np.random.Generator) -> None:
    a, b = images(rng)
    assert float(l1(a, b)) == pytest.approx(np.abs(a.numpy().astype(np.float64) - b.numpy()).mean(), rel=1e-6)
    assert float(l1(a, a)) == 0.0


@pytest.mark.parametrize("channels", [1, 3])
def test_a_mask_leaves_the_mean_over_what_it_covers(channels: int, rng: np.random.Generator) -> None:
    a, b = images(rng)
    mask = torch.from_numpy(rng.random((13, 17, channels)) < 0.4)
    chosen = np.broadcast_to(mask.numpy(), a.shape)
    expected = np.abs(a.numpy().astype(np.float64) - b.numpy())[chosen].mean()
    assert float(l1(a, b, mask)) == pytest.approx(expected, rel=1e-6)


def test_an_empty_mask_costs_nothing_and_pulls_nowhere(rng: np.random.Generator) -> None:
    a, b = images(rng)
    a.requires_grad_(True)
    loss = l1(a, b, torch.zeros(13, 17, 1, dtype=torch.bool))
    (gradient,) = torch.autograd.grad(loss, a)
    assert float(loss.detach()) == 0.0
    assert not gradient.any()


def test_the_gradient_is_the_sign_shared_among_the_covered(rng: np.random.Generator) -> None:
    a, b = images(rng)
    mask = torch.from_numpy(rng.random((13, 17, 1)) < 0.5)
    a.requires_grad_(True)
    (gradient,) = torch.autograd.grad(l1(a, b, mask), a)
    expected = torch.sign(a.detach() - b) * mask / (3 * mask.sum())
    torch.testing.assert_close(gradient, expected)

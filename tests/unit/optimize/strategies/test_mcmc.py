"""Relocation and noise of MCMC against integrals and float64."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatbot.gaussians.shape import covariances
from splatbot.optimize.adam import PARAMETERS
from splatbot.optimize.strategies import MCMCStrategy
from splatbot.optimize.strategies.edits import compute_relocation, inject_noise, relocate, sample_add
from tests.models import random_model
from tests.unit.optimize.strategies.steps import adam_of, step_of


@pytest.mark.parametrize("opacity", [1e-6, 0.005, 0.3, 0.9, 0.999, 0.999999])
@pytest.mark.parametrize("n", [1, 2, 3, 10, 51])
def test_n_copies_absorb_as_much_light_along_a_line_as_the_one_did(opacity: float, n: int) -> None:
    o, s = compute_relocation(torch.tensor([opacity]), torch.full((1, 3), 0.2), torch.tensor([n]))
    x = np.linspace(-4, 4, 200_001)
    one = opacity * np.exp(-0.5 * (x / 0.2) ** 2)
    copies = -np.expm1(n * np.log1p(-float(o.double()) * np.exp(-0.5 * (x / float(s[0, 0].double())) ** 2)))
    assert np.trapezoid(copies, x) == pytest.approx(np.trapezoid(one, x), rel=2e-4)
    assert copies[100_000] == pytest.approx(opacity, rel=1e-4)  # at the centre too
    assert bool((s > 0).all())


def test_one_copy_is_the_same_and_more_copies_than_the_table_count_as_its_last() -> None:
    o, s = torch.tensor([0.4, 0.4]), torch.tensor([[1.0, 2.0, 3.0]] * 2)
    same, scales = compute_relocation(o[:1], s[:1], torch.tensor([1]))
    torch.testing.assert_close((same, scales), (o[:1], s[:1]))
    many = compute_relocation(o, s, torch.tensor([51, 10_000]))
    assert torch.equal(many[0][0], many[0][1])


def test_dead_gaussians_move_onto_living_ones_which_share_their_opacity(rng: np.random.Generator) -> None:
    model = random_model(200, rng)
    model.opacity_logits[:] = 0.5
    dead = torch.arange(200) < 60
    model.opacity_logits[dead] = -9.0
    adam = adam_of(model)
    for name in PARAMETERS:
        adam.first[name] += 1
    moved = relocate(model, adam, dead, least_opacity=0.005, random=torch.Generator().manual_seed(1))
    origin = torch.cdist(moved.means[dead].double(), model.means[~dead].double()).argmin(1)
    assert torch.equal(moved.means[dead], model.means[~dead][origin])
    copies = torch.bincount(origin, minlength=140) + 1
    expected, scales = compute_relocation(model.opacities[~dead], model.scales[~dead], copies)
    torch.testing.assert_close(moved.opacities[~dead], expected, rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(moved.opacities[dead], expected[origin], rtol=1e-4, atol=1e-6)
    torch.testing.assert_close(moved.scales[dead], scales[origin], rtol=1e-5, atol=0)
    forgotten = adam.first["means"][~dead].abs().sum(1) == 0
    assert torch.equal(forgotten, copies > 1)


def test_draws_follow_opacity_and_new_rows_begin_without_moments(rng: np.random.Generator) -> None:
    model = random_model(3, rng)
    model.opacity_logits = torch.logit(torch.tensor([0.1, 0.3, 0.6]))
    adam = adam_of(model)
    grown = sample_add(model, adam, 20_000, least_opacity=0.005, random=torch.Generator().manual_seed(2))
    counts = np.array([int((grown.means[3:] == model.means[i]).all(1).sum()) for i in range(3)])
    assert counts.sum() == 20_000
    np.testing.assert_allclose(counts / 20_000, [0.1, 0.3, 0.6], atol=0.015)  # 4 σ of the largest
    assert len(adam.steps) == len(grown)
    assert not adam.first["means"][3:].any()


def test_noise_has_the_covariance_of_each_faint_gaussian_and_spares_opaque_ones(rng: np.random.Generator) -> None:
    model = random_model(2, rng)
    model.opacity_logits = torch.logit(torch.tensor([0.004, 0.5]))
    start = model.means.clone()
    random = torch.Generator().manual_seed(3)
    steps = []
    for _ in range(4000):
        model.means.copy_(start)
        inject_noise(model, 2.0, random=random)
        steps.append(model.means.clone() - start)
    moved = torch.stack(steps).double()
    assert not moved[:, 1].any()
    sigma = covariances(model)[0].double()
    gate = 1 / (1 + np.exp(-100 * (0.005 - 0.004)))
    expected = (2.0 * gate) ** 2 * sigma @ sigma
    found = moved[:, 0].T @ moved[:, 0] / len(moved)
    assert float((found - expected).norm() / expected.norm()) < 0.12  # some 2.5 standard errors of 4,000 draws


def test_growth_is_five_percent_up_to_the_cap(rng: np.random.Generator) -> None:
    model = random_model(100, rng)
    model.opacity_logits[:] = 2.0
    adam = adam_of(model)
    strategy = MCMCStrategy(cap_max=107, refine_start_iter=0, refine_every=1)
    sizes = []
    for step in range(1, 4):
        model = strategy.step_post_backward(model, {}, step_of(step, adam))
        sizes.append(len(model))
    assert sizes == [105, 107, 107]

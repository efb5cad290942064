"""Adam over rows that come and go, against torch.optim.Adam with one optimiser per Gaussian."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from splatbot.gaussians import GaussianModel
from splatbot.optimize.adam import PARAMETERS, GaussianAdam
from tests.models import random_model

RATES = {"means": 1e-3, "quats": 2e-3, "log_scales": 5e-3, "opacity_logits": 2e-2, "sh": 1e-2}


def gradients(model: GaussianModel, rng: np.random.Generator) -> dict[str, Tensor]:
    """Return random gradients of sizes from 1e-6 to 1."""
    out = {}
    for name in PARAMETERS:
        shape = tuple(getattr(model, name).shape)
        out[name] = torch.from_numpy((rng.normal(size=shape) * 10 ** rng.uniform(-6, 0, shape)).astype(np.float32))
    return out


class Oracle:
    """One torch Adam, in float64, for each Gaussian: it knows nothing of the others."""

    def __init__(self, model: GaussianModel) -> None:
        self.rows: list[tuple[dict[str, Tensor], torch.optim.Adam]] = []
        self.extend(model)

    def extend(self, model: GaussianModel) -> None:
        for i in range(len(self.rows), len(model)):
            values = {n: getattr(model, n)[i].detach().double().clone().requires_grad_(True) for n in PARAMETERS}
            groups = [{"params": [values[n]], "lr": RATES[n]} for n in PARAMETERS]
            self.rows.append((values, torch.optim.Adam(groups, betas=GaussianAdam.betas, eps=GaussianAdam.eps)))

    def select(self, index: Tensor) -> None:
        self.rows = [self.rows[i] for i in index.tolist()]

    def step(self, grads: dict[str, Tensor], visible: Tensor) -> None:
        for i in visible.nonzero()[:, 0].tolist():
            values, adam = self.rows[i]
            for name, value in values.items():
                value.grad = grads[name][i].double()
            adam.step()

    def assert_equals(self, model: GaussianModel) -> None:
        assert len(model) == len(self.rows)
        for name in PARAMETERS:
            expected = torch.stack([values[name].detach() for values, _ in self.rows])
            torch.testing.assert_close(getattr(model, name).double(), expected, rtol=2e-5, atol=2e-5)


def started(n: int, rng: np.random.Generator) -> tuple[GaussianModel, GaussianAdam, Oracle]:
    model = random_model(n, rng)
    adam = GaussianAdam(RATES)
    adam.extend(model)
    return model, adam, Oracle(model)


@pytest.mark.parametrize("share", [1.0, 0.4])
def test_equals_torch_adam_in_float64_and_each_gaussian_counts_the_steps_it_was_seen_in(
    share: float, rng: np.random.Generator
) -> None:
    model, adam, oracle = started(8, rng)
    for _ in range(30):
        grads, visible = gradients(model, rng), torch.from_numpy(rng.random(8) < share)
        adam.step(model, grads, visible)
        oracle.step(grads, visible)
    oracle.assert_equals(model)


def test_rows_added_and_removed_in_between_keep_their_own_moments(rng: np.random.Generator) -> None:
    model, adam, oracle = started(6, rng)
    for i in range(24):
        if i % 6 == 2:
            model = GaussianModel.concatenate([model, random_model(3, rng)])
            adam.extend(model)
            oracle.extend(model)
        if i % 6 == 4:
            index = torch.from_numpy(np.sort(rng.choice(len(model), len(model) - 2, replace=False)))
            model = model.select(index)
            adam.select(index)
            oracle.select(index)
        grads, visible = gradients(model, rng), torch.from_numpy(rng.random(len(model)) < 0.7)
        adam.step(model, grads, visible)
        oracle.step(grads, visible)
    assert len(model) == 6 + 4 * 3 - 4 * 2
    oracle.assert_equals(model)


def test_what_is_not_visible_keeps_its_bits(rng: np.random.Generator) -> None:
    model, adam, _ = started(5, rng)
    before = model.clone()
    visible = torch.tensor([True, False, True, False, False])
    adam.step(model, gradients(model, rng), visible)
    for name in PARAMETERS:
        assert torch.equal(getattr(model, name)[~visible], getattr(before, name)[~visible])
        assert not torch.equal(getattr(model, name)[visible], getattr(before, name)[visible])


def test_the_first_step_is_the_rate_whatever_the_size_of_the_gradient(rng: np.random.Generator) -> None:
    model, adam, _ = started(4, rng)
    before = model.clone()
    sizes = torch.tensor([1e-9, 1e-3, 1.0, 1e6])
    grads = {n: torch.ones_like(getattr(model, n)) * sizes.view(-1, *[1] * (getattr(model, n).ndim - 1)) for n in RATES}
    adam.step(model, grads, torch.ones(4, dtype=torch.bool))
    for name, rate in RATES.items():
        moved = getattr(before, name) - getattr(model, name)
        torch.testing.assert_close(moved, torch.full_like(moved, rate), rtol=1e-3, atol=1e-6)


@pytest.mark.parametrize("size", [0.0, 1e-30])
def test_gradients_of_zero_or_next_to_it_move_nothing(size: float, rng: np.random.Generator) -> None:
    model, adam, _ = started(4, rng)
    before = model.clone()
    adam.step(model, {n: torch.full_like(getattr(model, n), size) for n in PARAMETERS}, torch.ones(4, dtype=torch.bool))
    for name in PARAMETERS:
        torch.testing.assert_close(getattr(model, name), getattr(before, name), rtol=0, atol=1e-12)


def test_an_empty_model_takes_a_step_and_rows_afterwards(rng: np.random.Generator) -> None:
    adam, empty = GaussianAdam(RATES), GaussianModel.empty()
    adam.extend(empty)
    adam.step(empty, {n: torch.zeros_like(getattr(empty, n)) for n in PARAMETERS}, torch.zeros(0, dtype=torch.bool))
    model = random_model(3, rng)
    adam.extend(model)
    oracle = Oracle(model)
    grads, visible = gradients(model, rng), torch.ones(3, dtype=torch.bool)
    adam.step(model, grads, visible)
    oracle.step(grads, visible)
    oracle.assert_equals(model)

"""Pruning removes invisible and invalid Gaussians; the size limit is exact and keeps the best supported ones."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatbot.gaussians import GaussianModel
from splatbot.mapping.prune import best_supported, keep_mask
from tests.models import random_model
from tests.rgbd import small_config

CONFIG = small_config(mapping__min_opacity=0.05, mapping__max_scale=0.5).mapping


def test_sound_gaussians_stay(rng: np.random.Generator) -> None:
    assert keep_mask(random_model(50, rng), CONFIG).all()


def test_the_faint_and_the_huge_go_and_their_neighbours_stay(rng: np.random.Generator) -> None:
    model = random_model(6, rng)
    model.opacity_logits[:2] = torch.logit(torch.tensor([0.049, 0.051]))
    model.log_scales[2:4, 1] = torch.tensor([0.501, 0.499]).log()
    assert keep_mask(model, CONFIG).tolist() == [False, True, False, True, True, True]


@pytest.mark.parametrize("column", ["means", "quats", "log_scales", "opacity_logits"])
@pytest.mark.parametrize("value", [np.nan, np.inf, -np.inf])
def test_gaussians_that_are_not_finite_are_removed(column: str, value: float, rng: np.random.Generator) -> None:
    model = random_model(5, rng)
    getattr(model, column)[3] = value
    assert keep_mask(model, CONFIG).tolist() == [True, True, True, False, True]


@pytest.mark.parametrize("value", [np.nan, np.inf])
def test_a_colour_that_is_not_finite_goes(value: float, rng: np.random.Generator) -> None:
    model = random_model(3, rng)
    model.sh[1, 0, 2] = value
    assert keep_mask(model, CONFIG).tolist() == [True, False, True]


def test_an_empty_model_has_nothing_to_prune() -> None:
    assert keep_mask(GaussianModel.empty(), CONFIG).shape == (0,)
    assert best_supported(GaussianModel.empty(), 10).shape == (0,)


@pytest.mark.parametrize("count", [0, 1, 37, 99, 100, 1000])
def test_the_cap_holds_exactly_and_keeps_those_seen_most_often_then_the_most_opaque(
    count: int, rng: np.random.Generator
) -> None:
    model = random_model(100, rng)
    model.observations = torch.from_numpy(rng.integers(0, 6, 100).astype(np.int32))
    kept = best_supported(model, count).tolist()
    merit = sorted(range(100), key=lambda i: (-int(model.observations[i]), -float(model.opacities[i])))
    assert kept == sorted(merit[:count])


def test_guesses_are_the_first_to_go(rng: np.random.Generator) -> None:
    model = random_model(10, rng)
    model.observations[:4] = 0
    model.opacity_logits[:4] = 5.0
    assert best_supported(model, 6).tolist() == [4, 5, 6, 7, 8, 9]


def test_of_equals_the_oldest_stay(rng: np.random.Generator) -> None:
    model = random_model(1, rng).select(torch.zeros(20, dtype=torch.long))
    assert best_supported(model, 7).tolist() == list(range(7))

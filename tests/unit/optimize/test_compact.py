"""Compaction: the number is kept, no surface vanishes, and detail remains where images show it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch

from splatbot.collision import GaussianCollisionField
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.optimize.compact import compact, field_change
from tests.models import random_model, uniform_model


def wall(n: int = 40) -> GaussianModel:
    """Return a wall of n x n thin discs, 1 cm apart; its left half is grey, its right half has random colours."""
    rng = np.random.default_rng(0)
    x, y = (axis.ravel() for axis in np.meshgrid(np.arange(n), np.arange(n)))
    colors = np.where((x < n // 2)[:, None], 0.5, rng.uniform(0, 1, (n * n, 3)))
    return GaussianModel.from_activated(
        means=np.c_[0.01 * x, 0.01 * y, np.ones(n * n)],
        quats=np.tile([1.0, 0, 0, 0], (n * n, 1)),
        scales=np.tile([5e-3, 5e-3, 5e-4], (n * n, 1)),
        opacities=np.full(n * n, 0.8),
        colors=colors,
    )


@pytest.mark.parametrize("share", [0.75, 0.25, 0.01])
@pytest.mark.parametrize("n_sigma", [2.0, 3.0])
@pytest.mark.parametrize("model", [wall(), random_model(2_000, np.random.default_rng(0))], ids=["wall", "random"])
def test_no_sphere_is_free_that_the_original_hits(model: GaussianModel, share: float, n_sigma: float) -> None:
    weights = torch.from_numpy(np.random.default_rng(1).uniform(0, 100, len(model))).float()
    compacted = compact(model, weights, round(share * len(model)))
    assert len(compacted) <= round(share * len(model))
    rng = np.random.default_rng(2)
    points = model.means.numpy()[rng.integers(0, len(model), 20_000)] + rng.normal(0, 0.02, (20_000, 3))
    spheres = np.c_[points, rng.uniform(0, 0.02, 20_000)]
    hit, hit_after = (GaussianCollisionField(m, n_sigma).in_collision(spheres) for m in (model, compacted))
    assert hit.sum() > 1_000
    assert (hit & ~hit_after).sum() == 0


def test_detail_stays_where_colours_differ() -> None:
    model = wall()
    compacted = compact(model, torch.full((len(model),), 50.0), len(model) // 2)
    right = compacted.means[:, 0] > 0.2
    assert right.sum() > 3 * (~right).sum()


def test_detail_stays_where_views_show_it() -> None:
    model = uniform_model(np.random.default_rng(0).uniform(0, 1, (1_000, 3)), scale=0.01)
    seen = model.means[:, 0] < 0.5
    compacted = compact(model, torch.where(seen, 1_000.0, 1.0), 300)
    assert (compacted.means[:, 0] < 0.5).float().mean() > 0.8


def test_single_gaussians_are_unchanged_and_come_first() -> None:
    model = random_model(300, np.random.default_rng(3))
    compacted = compact(model, torch.arange(300.0), 200)
    known = {tuple(row) for row in model.means.tolist()}
    same = [tuple(row) in known for row in compacted.means.tolist()]
    first = same.index(False)
    assert first > 50
    assert not any(same[first:])


def test_a_map_within_the_number_is_unchanged() -> None:
    model = random_model(20, np.random.default_rng(4))
    compacted = compact(model, torch.zeros(20), 20)
    assert torch.equal(compacted.means, model.means)


def test_a_gaussian_that_neither_images_nor_collision_checks_count_is_removed() -> None:
    model = random_model(4, np.random.default_rng(5))
    model = replace(model, observations=torch.tensor([1, 0, 1, 0], dtype=torch.int32))
    compacted = compact(model, torch.tensor([1.0, 1.0, 0.0, 0.0]), 4)
    assert torch.equal(compacted.means, model.means[:3])


def test_gaussians_at_one_place_become_one() -> None:
    compacted = compact(uniform_model(np.zeros((50, 3))), torch.ones(50), 10)
    assert len(compacted) == 1
    assert compacted.scales.max() == pytest.approx(0.1, rel=0.01)


def test_support_of_a_group_is_that_of_its_best_member() -> None:
    model = uniform_model(np.array([[0.0, 0, 0], [0.1, 0, 0]]))
    model = replace(model, observations=torch.tensor([7, 0], dtype=torch.int32))
    compacted = compact(model, torch.ones(2), 1)
    assert compacted.observations.tolist() == [7]
    assert torch.isfinite(compacted.opacity_logits).all()


def test_it_repeats_bit_for_bit() -> None:
    model = random_model(500, np.random.default_rng(6))
    first, second = (compact(model, torch.arange(500.0), 100) for _ in range(2))
    assert torch.equal(first.means, second.means)
    assert torch.equal(first.log_scales, second.log_scales)


def test_the_change_of_a_field_counts_missed_and_blocked_spheres() -> None:
    ball = uniform_model(np.zeros((1, 3)), scale=0.01)
    larger, smaller = (replace(ball, log_scales=ball.log_scales + np.log(f)) for f in (1.5, 0.5))
    assert field_change(ball, ball).missed == field_change(ball, ball).blocked == 0
    grown, shrunk = field_change(ball, larger), field_change(ball, smaller)
    assert grown.missed == 0
    assert grown.closer_m == pytest.approx(0.01, abs=1e-3)  # two standard deviations of 5 mm more
    assert grown.blocked > 0
    assert shrunk.missed > 0


@pytest.mark.parametrize("count", [0, -3])
def test_a_number_below_one_is_refused(count: int) -> None:
    with pytest.raises(InputError, match="count"):
        compact(random_model(3, np.random.default_rng(0)), torch.ones(3), count)


def test_a_map_that_nothing_counts_is_refused() -> None:
    model = replace(uniform_model(np.zeros((2, 3))), observations=torch.zeros(2, dtype=torch.int32))
    with pytest.raises(InputError, match="no Gaussian"):
        compact(model, torch.zeros(2), 1)

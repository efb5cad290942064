"""Limits that keep Gaussians on measured surfaces."""

from __future__ import annotations

import math

import numpy as np
import torch

from splatbot.gaussians.shape import shortest_axes
from splatbot.optimize.surfaces import limit_normal_motion, limit_shape
from tests.models import random_model


def test_the_part_of_a_step_along_the_normal_is_scaled_and_the_rest_is_kept(rng: np.random.Generator) -> None:
    model = random_model(30, rng)
    rows = torch.arange(0, 30, 2)
    means, normals = model.means[rows].clone(), shortest_axes(model, rows)
    others = model.means[1::2].clone()
    step = torch.from_numpy(rng.normal(size=(15, 3)).astype(np.float32))
    model.means[rows] += step
    limit_normal_motion(model, rows, means, normals, 0.25)
    moved = (model.means[rows] - means).double()
    n, full = normals.double(), step.double()
    torch.testing.assert_close((moved * n).sum(1), 0.25 * (full * n).sum(1), rtol=1e-4, atol=1e-6)
    across = full - (full * n).sum(1, keepdim=True) * n
    torch.testing.assert_close(moved - (moved * n).sum(1, keepdim=True) * n, across, rtol=1e-4, atol=1e-6)
    assert torch.equal(model.means[1::2], others)


def test_needles_and_balls_become_discs_of_bounded_size_in_the_view(rng: np.random.Generator) -> None:
    model = random_model(40, rng)
    model.means[:, 2] = 2.0
    model.log_scales[:20] = math.log(0.05)  # balls
    model.log_scales[20:, 1] = math.log(3.0)  # needles of 3 m
    before = model.scales.clone()
    rows = torch.arange(40)
    limit_shape(model, rows, torch.eye(4), 500.0, max_pixels=6.0, thickness=0.2)
    sizes = model.scales.sort(1).values
    assert float(sizes[:, 2].max()) <= 6.0 * 2.0 / 500.0 * 1.0001
    assert bool((sizes[:, 0] <= 0.2001 * sizes[:, 1]).all())
    assert bool((model.scales <= before * 1.0001).all())

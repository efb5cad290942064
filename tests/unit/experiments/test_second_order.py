"""Gauss-Newton steps of training: blocks that random signs estimate, their solution, and steps that lower the loss."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from experiments.second_order import Scene, _outer, _solve, adam_steps, gauss_newton_steps, run
from splatbot.training.images import ImageCache
from splatbot.training.options import TrainingOptions
from tests.unit.training.rendered import rendered_data, true_model


def scene() -> Scene:
    data = rendered_data(8)
    train, held_out = data.split(4)
    start = true_model()
    torch.manual_seed(0)
    start.means += 0.02 * torch.randn_like(start.means)
    start.sh -= 0.1
    options = TrainingOptions(iterations=1, sh_degree=0)
    return Scene(start, ImageCache(train), ImageCache(held_out), options, data.scene_extent)


def test_products_of_probes_with_random_signs_have_the_mean_of_the_gauss_newton_matrix() -> None:
    rng = np.random.default_rng(0)
    jacobian = rng.normal(size=(50, 3))
    signs = rng.choice([-1.0, 1.0], size=(20_000, 50))
    probes = torch.from_numpy(signs @ jacobian)
    np.testing.assert_allclose(_outer(probes, blocks=True).mean(0), jacobian.T @ jacobian, atol=1.5)
    np.testing.assert_allclose(_outer(probes, blocks=False).mean(0), (jacobian**2).sum(0), rtol=0.05)


def test_each_row_is_solved_with_its_own_damping() -> None:
    rng = np.random.default_rng(1)
    root, g = rng.normal(size=(4, 3, 3)), rng.normal(size=(4, 3))
    h = root @ root.transpose(0, 2, 1)
    solved = _solve(torch.from_numpy(h), torch.from_numpy(g), blocks=True)
    for row in range(4):
        damped = h[row] + (0.1 * np.trace(h[row]) / 3 + 1e-12) * np.eye(3)
        np.testing.assert_allclose(solved[row], np.linalg.solve(damped, g[row]), rtol=1e-9)


@pytest.mark.parametrize("kind", ["adam", "diagonal", "blocks"])
def test_steps_raise_the_score_of_held_out_views(kind: str) -> None:
    s = scene()
    step = adam_steps(s, 1.0, squares=True) if kind == "adam" else gauss_newton_steps(s, 0.02, blocks=kind == "blocks")
    model = s.start.clone()
    for number in range(60):
        step(model, number / 60)
    assert s.psnr(model) > s.psnr(s.start) + 0.5


def test_a_run_is_scored_at_each_quarter_also_if_one_step_takes_longer() -> None:
    s = scene()
    scores, steps = run(s, adam_steps(s, 1.0, squares=True), 1e-9)
    assert (len(scores), steps) == (4, 1)

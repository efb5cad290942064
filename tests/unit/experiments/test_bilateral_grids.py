"""Bilateral grids: slicing by place and luma, their steps, and a training with them."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from scipy.interpolate import RegularGridInterpolator

from experiments.bilateral_grids import (
    COLUMNS,
    LEVELS,
    ROWS,
    BilateralGrids,
    GridTrainer,
    floor,
    sliced,
    total_variation,
)
from splatbot.training.options import TrainingOptions

IDENTITY = torch.eye(3, 4, dtype=torch.float64).reshape(12)


def random_view(seed: int = 0) -> tuple[torch.Tensor, ...]:
    """Return colours (5, 6, 3), alpha (5, 6, 1), a background (3,) and a grid (12, 8, 16, 16), all float64."""
    values = torch.Generator().manual_seed(seed)
    shapes = (5, 6, 3), (5, 6, 1), (3,), (12, LEVELS, ROWS, COLUMNS)
    return tuple(torch.rand(shape, generator=values, dtype=torch.float64) for shape in shapes)


def test_each_pixel_has_the_transform_that_trilinear_interpolation_by_place_and_luma_gives() -> None:
    colors, alpha, background, grid = random_view()
    image, mean = sliced(colors, alpha, background, grid)
    behind = (1 - alpha) * background
    parts = (colors - behind).numpy()
    axes = (np.linspace(0, 1, LEVELS), np.linspace(0, 1, ROWS), np.linspace(0, 1, COLUMNS))
    look_up = RegularGridInterpolator(axes, grid.permute(1, 2, 3, 0).numpy())
    expected = np.zeros((5, 6, 3))
    total = np.zeros(12)
    for v in range(5):
        for u in range(6):
            luma = np.clip(parts[v, u] @ [0.299, 0.587, 0.114], 0, 1)
            found = look_up([luma, (v + 0.5) / 5, (u + 0.5) / 6])[0]
            expected[v, u] = found.reshape(3, 4) @ [*parts[v, u], float(alpha[v, u])] + behind[v, u].numpy()
            total += found * float(alpha[v, u])
    np.testing.assert_allclose(image, expected, atol=1e-12)
    np.testing.assert_allclose(mean, total / float(alpha.sum()), atol=1e-12)


def test_the_gradients_of_a_sliced_render_equal_finite_differences() -> None:
    colors, alpha, background, grid = random_view(1)

    def image(colors: torch.Tensor, alpha: torch.Tensor, cell: torch.Tensor) -> torch.Tensor:
        return sliced(colors, alpha, background, grid + cell[:, None, None, None])[0]

    inputs = [colors.requires_grad_(), alpha.requires_grad_(), torch.zeros(12, dtype=torch.float64, requires_grad=True)]
    assert torch.autograd.gradcheck(image, inputs)


def test_new_grids_leave_every_image_and_an_empty_view_as_they_are() -> None:
    colors, alpha, background, _ = (value.float() for value in random_view())
    (grid,) = BilateralGrids(3).of_views([1])
    torch.testing.assert_close(sliced(colors, alpha, background, grid)[0], colors, atol=1e-6, rtol=0)
    image, mean = sliced(colors, torch.zeros_like(alpha), background, grid)
    torch.testing.assert_close(image, colors, atol=1e-6, rtol=0)
    torch.testing.assert_close(mean.double(), IDENTITY, atol=0, rtol=0)


def test_total_variation_is_the_mean_squared_difference_of_neighbours_along_each_axis() -> None:
    grid = random_view(2)[3]
    expected = sum(np.mean(np.diff(grid.numpy(), axis=axis) ** 2) for axis in (1, 2, 3))
    assert float(total_variation(grid)) == pytest.approx(expected, rel=1e-12)
    assert float(total_variation(torch.ones(12, LEVELS, ROWS, COLUMNS))) == 0.0


def test_a_step_is_that_of_adam_and_the_mean_transform_stays_the_identity() -> None:
    grids, draws = BilateralGrids(4), torch.Generator().manual_seed(3)
    values = [grids.of_views([view])[0].clone().requires_grad_() for view in range(4)]
    adam = torch.optim.Adam(values, lr=0.01, eps=1e-15)  # steps the values that have a gradient
    means = IDENTITY.repeat(4, 1)
    for _ in range(20):
        views = torch.randint(4, (2,), generator=draws).tolist()  # a view may come twice
        gradients = torch.randn(2, *values[0].shape, generator=draws)
        shift = means.mean(0) - IDENTITY
        of_views = grids.of_views(views).double().mean((2, 3, 4))
        grids.step(views, gradients, of_views, 0.01)
        means[views] = of_views + shift
        adam.zero_grad()
        for view, gradient in zip(views, gradients, strict=True):
            values[view].grad = gradient + (0.0 if (grad := values[view].grad) is None else grad)
        adam.step()
    moved = torch.stack([value.detach().double() for value in values])
    shift = (means.mean(0) - IDENTITY).reshape(12, 1, 1, 1)
    torch.testing.assert_close(grids.of_views([0, 1, 2, 3]).double(), moved - shift, atol=2e-6, rtol=0)
    assert float(shift.abs().max()) > 1e-5


def test_grids_take_over_a_tint_and_their_mean_stays_near_the_identity() -> None:
    options = TrainingOptions(iterations=40, strategy="fixed", sh_degree=0, max_gaussians=1200, batch=2)
    trainer = GridTrainer(floor(2, tint=0.3), options, 10.0)
    losses = [trainer.step(0.3) for _ in range(40)]
    assert sum(losses[-8:]) < 0.8 * sum(losses[:8])
    means = trainer.grids.means - trainer.grids.shift
    torch.testing.assert_close(means.mean(0), IDENTITY, atol=1e-9, rtol=0)
    assert float((means - IDENTITY).abs().max()) > 0.02

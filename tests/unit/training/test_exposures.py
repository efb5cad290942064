"""Colour transforms of photographs with different exposures."""

from __future__ import annotations

from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from numpy.typing import NDArray

from splatbot.training.datasets import TrainingData, TrainingView
from splatbot.training.exposures import ExposureTransforms, exposed, fitted_exposure
from splatbot.training.images import ImageCache
from splatbot.training.initialize import initial_model
from splatbot.training.options import TrainingOptions
from splatbot.training.scoring import score_held_out, summary
from splatbot.training.trainer import Trainer
from tests.unit.training.rendered import rendered_data

pytestmark = pytest.mark.usefixtures("default_kernels")

GRAY = 0.35


def random_view() -> tuple[torch.Tensor, ...]:
    """Return colours (5, 6, 3), alpha (5, 6, 1), a background (3,) and a transform (3, 4), all float64."""
    values = torch.Generator().manual_seed(0)
    shapes = (5, 6, 3), (5, 6, 1), (3,), (3, 4)
    return tuple(torch.rand(shape, generator=values, dtype=torch.float64) for shape in shapes)


def test_the_gradients_of_an_exposed_render_equal_finite_differences() -> None:
    inputs = [value.requires_grad_() for value in random_view()]
    assert torch.autograd.gradcheck(exposed, inputs)


def test_the_map_is_transformed_and_its_background_is_not() -> None:
    colors, alpha, background, transform = random_view()
    opaque = exposed(colors, torch.ones_like(alpha), background, transform)
    expected = np.einsum("ij,hwj->hwi", transform[:, :3], colors) + transform[:, 3].numpy()
    np.testing.assert_allclose(opaque, expected, atol=1e-12)
    empty = exposed(background.expand(5, 6, 3), torch.zeros_like(alpha), background, transform)
    np.testing.assert_allclose(empty, background.expand(5, 6, 3), atol=1e-12)


def test_the_transform_of_least_squares_is_the_one_that_a_photograph_has() -> None:
    colors, alpha, background, transform = random_view()
    image = exposed(colors, alpha, background, transform)
    counted = torch.ones(5, 6, dtype=torch.bool)
    counted[0] = False
    image[0] = 7.0  # not counted
    found = fitted_exposure(colors, alpha, background, image, counted)
    torch.testing.assert_close(found, transform, atol=1e-9, rtol=0)


def test_a_step_is_that_of_adam_less_its_mean_and_the_mean_stays_the_identity() -> None:
    exposures, draws = ExposureTransforms(5), torch.Generator().manual_seed(1)
    values = [torch.zeros(3, 4, requires_grad=True) for _ in range(5)]
    adam = torch.optim.Adam(values, lr=0.01)  # steps the values that have a gradient
    for step in range(40):
        views = torch.randint(5, (2,), generator=draws).tolist()  # a view may come twice
        gradients = torch.randn(2, 3, 4, generator=draws, dtype=torch.float64)
        rate = 0.01 * 0.1 ** (step / 40)
        exposures.step(views, gradients, rate)
        adam.param_groups[0]["lr"] = rate
        adam.zero_grad()
        for view, gradient in zip(views, gradients, strict=True):
            values[view].grad = gradient.float() + (0.0 if (grad := values[view].grad) is None else grad)
        adam.step()
    identity = torch.eye(3, 4, dtype=torch.float64)
    moved = torch.stack([value.detach().double() for value in values])
    torch.testing.assert_close(exposures.transforms, identity + moved - moved.mean(0), atol=1e-6, rtol=0)
    torch.testing.assert_close(exposures.transforms.mean(0), identity, atol=1e-12, rtol=0)
    assert float(moved.abs().max()) > 0.05


def with_gains(data: TrainingData, gains: NDArray[np.float64]) -> TrainingData:
    """Return the photographs darkened to 0.7 of their brightness, times a gain each."""

    def changed(view: TrainingView, gain: float) -> TrainingView:
        rgba = view.read().astype(np.float64)
        rgba[..., :3] *= 0.7 * gain  # at most 255: nothing is clipped
        return replace(view, read=partial(np.copy, np.rint(rgba).astype(np.uint8)))

    return replace(data, views=tuple(changed(view, gain) for view, gain in zip(data.views, gains, strict=True)))


def trained(data: TrainingData, *, exposure: bool) -> tuple[Trainer, float, float]:
    """Train on the simulated scene; return the trainer, PSNR and colour-corrected PSNR of the held-out views [dB]."""
    train, held_out = data.split()
    options = TrainingOptions(iterations=400, batch=2, max_gaussians=1500, background="white", exposure=exposure)
    images = ImageCache(train)
    trainer = Trainer(initial_model(data, images, most=1500, seed=0), images, options, data.scene_extent)
    for step in range(400):
        trainer.step(step / 400)
    scores = summary(score_held_out(trainer.model, ImageCache(held_out), options, data.scene_extent))
    return trainer, float(scores["psnr_db"]), float(scores["corrected_psnr_db"])


@pytest.mark.long
def test_photographs_of_different_gains_give_the_map_of_equal_ones() -> None:
    data = rendered_data(points=300)
    trains = np.arange(len(data.views)) % 8 > 0
    gains = np.ones(len(data.views))
    gains[trains] = np.random.default_rng(0).permutation(np.linspace(0.7, 1.4, int(trains.sum())))
    gains[trains] /= gains[trains].mean()  # the map has the mean exposure; held-out views have gain 1
    _, clean, corrected_clean = trained(with_gains(data, np.ones_like(gains)), exposure=False)
    _, ignored, corrected_ignored = trained(with_gains(data, gains), exposure=False)
    trainer, found, corrected = trained(with_gains(data, gains), exposure=True)
    print(f"held-out PSNR: {clean:.1f} dB of equal gains, {ignored:.1f} dB ignored, {found:.1f} dB compensated")
    print(f"colour-corrected: {corrected_clean:.1f} dB, {corrected_ignored:.1f} dB, {corrected:.1f} dB")
    assert found > max(clean - 1.0, ignored + 1.5)
    assert corrected > max(corrected_clean - 0.5, corrected_ignored + 1.0)
    assert trainer.exposures is not None
    transforms = trainer.exposures.transforms
    gray = (GRAY * transforms[..., :3].sum(-1) + transforms[..., 3]).mean(-1).numpy() / GRAY
    assert np.linalg.norm(gray - gains[trains]) < 0.5 * np.linalg.norm(1.0 - gains[trains])

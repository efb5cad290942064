"""The trainer on photographs of known Gaussians."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch

from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import se3_exp
from splatbot.training.datasets import TrainingData, TrainingView
from splatbot.training.images import ImageCache
from splatbot.training.initialize import initial_model
from splatbot.training.options import TrainingOptions
from splatbot.training.rendering import render_photo
from splatbot.training.scoring import score_held_out, summary
from splatbot.training.trainer import Trainer
from tests.unit.training.rendered import rendered_data

pytestmark = pytest.mark.usefixtures("default_kernels")


def trained(iterations: int, *, data: TrainingData | None = None, **options: Any) -> tuple[Trainer, float]:
    """Train on the rendered scene; return the trainer and the PSNR of the held-out views [dB]."""
    data = data or rendered_data(points=300)
    train, held_out = data.split()
    settings = TrainingOptions(iterations=iterations, max_gaussians=1500, background="white", **options)
    images = ImageCache(train)
    trainer = Trainer(initial_model(data, images, most=1500, seed=0), images, settings, data.scene_extent)
    for i in range(iterations):
        trainer.step(i / iterations)
    scores = score_held_out(trainer.model, ImageCache(held_out), settings, data.scene_extent)
    return trainer, float(summary(scores)["psnr_db"])


@pytest.mark.long
@pytest.mark.parametrize("strategy", ["default", "absgrad", "mcmc", "fixed"])
def test_held_out_views_are_explained(strategy: str) -> None:
    _, before = trained(1, strategy=strategy)
    _, after = trained(400, strategy=strategy)
    assert after > before + 6
    assert after > 26


def test_random_points_become_the_object_without_any_given_point() -> None:
    _, psnr_db = trained(500, data=rendered_data())
    assert psnr_db > 24


def test_depth_draws_the_surface_to_the_measured_one() -> None:
    errors = {}
    for weight in (0.0, 0.5):
        trainer, _ = trained(200, data=rendered_data(points=300, depth=True), depth_weight=weight)
        photo = trainer.images.photo(0)
        with torch.no_grad():
            render = render_photo(trainer.model, photo, trainer.poses.viewmats[0], torch.zeros(3), 3)
        assert photo.depth is not None
        seen = (photo.depth > 0) & (render.alpha[..., 0] > 0.5)
        errors[weight] = float((render.image[..., 3] - photo.depth)[seen].abs().mean())
    assert errors[0.5] < 0.8 * errors[0.0]


@pytest.mark.parametrize("strategy", ["default", "mcmc"])
def test_a_restored_trainer_takes_the_same_steps_bit_for_bit(strategy: str) -> None:
    data = rendered_data(8, points=200)
    options = TrainingOptions(
        iterations=1000,
        strategy=strategy,  # type: ignore[arg-type]
        refine_poses=True,
        refine_intrinsics=True,
        exposure=True,
        background="random",
    )
    images = ImageCache(data.views)
    start = initial_model(data, images, most=200, seed=0)
    whole = Trainer(start, images, options, 2.0)
    whole.iteration = 490  # past the first change of the Gaussians within the steps below
    for _ in range(30):
        whole.step(0.3)
    first = Trainer(start, images, options, 2.0)
    first.iteration = 490
    for _ in range(13):
        first.step(0.3)
    second = Trainer(start, images, options, 2.0)
    second.restore(first.state())
    for _ in range(17):
        second.step(0.3)
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh"):
        assert torch.equal(getattr(whole.model, name), getattr(second.model, name))
    for kind, name in (("poses", "viewmats"), ("intrinsics", "changes"), ("exposures", "transforms")):
        assert torch.equal(whole.state()[kind][name], second.state()[kind][name])


@pytest.mark.long
def test_refined_poses_make_up_for_disturbed_ones() -> None:
    rng = np.random.default_rng(2)

    def disturb(view: TrainingView) -> TrainingView:
        return replace(view, T_world_camera=view.T_world_camera @ se3_exp(rng.normal(scale=0.01, size=6)))

    data = rendered_data(points=300)
    disturbed = replace(data, views=tuple(disturb(view) for view in data.views))
    _, true = trained(700, data=data)
    _, as_given = trained(700, data=disturbed)
    _, refined = trained(700, data=disturbed, refine_poses=True)
    assert as_given < true - 3
    assert refined > max(true - 2, as_given + 3)


def test_an_empty_model_and_a_view_that_sees_nothing_are_trained_without_error() -> None:
    data = rendered_data(3, points=10)
    images = ImageCache(data.views)
    options = TrainingOptions(iterations=10)
    far = initial_model(data, images, most=10, seed=0)
    far.means += 1e4
    for model in (GaussianModel.empty(), far):
        trainer = Trainer(model, images, options, 1.0)
        losses = [trainer.step(0.5) for _ in range(3)]
        assert np.isfinite(losses).all()


@pytest.mark.parametrize(
    ("values", "field"),
    [
        ({"iterations": None}, "iterations"),
        ({"iterations": 0}, "iterations"),
        ({"minutes": float("nan")}, "minutes"),
        ({"max_gaussians": 0}, "max_gaussians"),
        ({"sh_degree": 5}, "sh_degree"),
        ({"dssim_weight": -0.1}, "dssim_weight"),
    ],
)
def test_options_out_of_range_are_named(values: dict[str, Any], field: str) -> None:
    with pytest.raises(InputError, match=field):
        TrainingOptions(**values)

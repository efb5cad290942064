"""Densifying: two halves have the moments of the whole, the hardest pulled go first, and pictures become sharper."""

from __future__ import annotations

import numpy as np
import pytest
import torch

from splatbot.config import Config, MappingConfig
from splatbot.evaluation.image import psnr
from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import covariances
from splatbot.logs import open_log
from splatbot.mapping.densify import PositionGradients, split
from splatbot.rasterize.views import render_rgbd
from splatbot.slam import Slam


def some(count: int = 5) -> GaussianModel:
    rng = np.random.default_rng(0)
    return GaussianModel.from_activated(
        means=rng.normal(size=(count, 3)),
        quats=rng.normal(size=(count, 4)),
        scales=rng.uniform(0.002, 0.03, (count, 3)),
        opacities=rng.uniform(0.1, 0.9, count),
        colors=rng.uniform(size=(count, 3)),
    )


def test_two_halves_have_the_mean_and_covariance_of_the_whole_and_all_else_of_it() -> None:
    model = some()
    model.observations += torch.arange(5, dtype=torch.int32)
    rows = torch.tensor([1, 4])
    found = split(model, rows)
    assert len(found) == 7
    whole = covariances(model).double().numpy()
    halves = covariances(found).double().numpy()
    at = found.means.double().numpy()
    for row, second in ((1, 5), (4, 6)):
        mean = (at[row] + at[second]) / 2
        spread = (halves[row] + halves[second]) / 2 + np.outer(at[row] - mean, at[row] - mean)
        np.testing.assert_allclose(mean, model.means[row], atol=1e-6)
        np.testing.assert_allclose(spread, whole[row], atol=1e-8)
        assert np.linalg.norm(at[row] - at[second]) > float(model.scales[row].max())
        for name in ("quats", "opacity_logits", "sh", "observations", "uncertainty"):
            of = getattr(found, name)
            torch.testing.assert_close(of[[row, second]], getattr(model, name)[[row, row]])
    for name in ("means", "quats", "log_scales"):
        torch.testing.assert_close(getattr(found, name)[[0, 2, 3]], getattr(model, name)[[0, 2, 3]], rtol=0, atol=0)


def test_the_largest_gradients_beyond_the_limit_are_chosen_up_to_the_cap_for_any_image_size() -> None:
    gradients = PositionGradients(5)
    assert len(gradients.largest(0.0, 9)) == 0
    for width in (100, 400):
        image_gradients = torch.tensor([[3.0, 4.0], [0.0, 2.0], [6.0, 8.0], [float("nan"), 1.0]]) / width
        gradients.add(torch.tensor([0, 1, 3, 4]), image_gradients, width)
    gradients.add(torch.tensor([0]), torch.zeros(1, 2), 100)  # one more observation lowers the mean to 5/3
    assert gradients.largest(0.9, 9).tolist() == [0, 1, 3]
    assert gradients.largest(0.9, 2).tolist() == [0, 3]
    assert gradients.largest(0.9, -1).tolist() == []
    assert gradients.largest(1.2, 9).tolist() == [0, 3]


@pytest.mark.long
@pytest.mark.parametrize("cap", [150_000, 5_000])
def test_a_finished_map_is_denser_where_its_pictures_are_not_met_and_under_its_cap(cap: int) -> None:
    log = open_log("synthetic:tabletop?frames=6&width=160&height=120&trajectory=orbit&rate=3")
    fidelity, size = [], []
    for limit in (1e9, 3e-4):
        keys = {"densify_gradient": limit, "final_iterations": 90, "max_gaussians": cap}
        slam = Slam(Config(mapping=MappingConfig(**keys)))
        poses = [slam.process(frame).T_world_camera for frame in log]
        slam.finish()
        model = slam.snapshot().model
        views = [render_rgbd(model, frame.camera, T)[0] for frame, T in zip(log, poses, strict=True) if T is not None]
        fidelity.append(np.mean([psnr(view, frame.rgb / 255.0) for view, frame in zip(views, log, strict=True)]))
        size.append(len(model))
    assert max(size) <= cap
    if cap == 150_000:
        assert size[1] > 1.05 * size[0]
        assert fidelity[1] > fidelity[0] + 0.3

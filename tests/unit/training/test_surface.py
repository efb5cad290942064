"""Losses that draw surfels to one surface, against closed forms."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import so3_exp
from splatbot.rasterize.maps import MapRender, render_map
from splatbot.training.options import TrainingOptions
from splatbot.training.surface import SurfaceWeights, surface_loss
from tests.surfels import wall

pytestmark = pytest.mark.usefixtures("one_torch_thread", "default_kernels")
K = torch.tensor([[40.0, 0.0, 24.0], [0.0, 40.0, 18.0], [0.0, 0.0, 1.0]])
BOTH = SurfaceWeights(0.05, 0.01)


def discs(means: np.ndarray, quats: np.ndarray, sigma: float, opacity: float) -> GaussianModel:
    n = len(means)
    return GaussianModel.from_activated(
        means=means,
        quats=quats,
        scales=np.tile([sigma, sigma, 0.0], (n, 1)),
        opacities=np.full(n, opacity),
        colors=np.full((n, 3), 0.5),
    )


def rendered(model: GaussianModel) -> MapRender:
    return render_map(model, torch.eye(4), K, 48, 36, render_mode="RGB+ED", distortion=True)


def test_the_weights_begin_at_the_shares_of_the_paper_and_the_distortion_is_that_of_a_scene_of_any_scale() -> None:
    options = TrainingOptions(surfels=True)
    starts = {"normal": 7000 / 30000, "distortion": 3000 / 30000}
    for name, start in starts.items():
        assert getattr(SurfaceWeights.at(options, start - 1e-6, 2.0), name) == 0
        assert getattr(SurfaceWeights.at(options, start + 1e-6, 2.0), name) > 0
    assert SurfaceWeights.at(options, 1.0, 2.0) == SurfaceWeights(0.05, 0.005)
    assert SurfaceWeights.at(replace(options, surfels=False), 1.0, 2.0) == SurfaceWeights()


def test_discs_in_their_plane_agree_with_its_depth_and_turned_ones_do_not() -> None:
    tilt = torch.from_numpy(so3_exp([0.4, 0.1, 0.0]))
    scene, losses = wall(tilt), []
    for turn in (0.0, 0.6):
        w, x = math.cos(turn / 2), math.sin(turn / 2)
        q = scene.quats.double().numpy()
        turned = np.column_stack(
            [
                q[:, 0] * w - q[:, 1] * x,
                q[:, 0] * x + q[:, 1] * w,
                q[:, 2] * w + q[:, 3] * x,
                q[:, 3] * w - q[:, 2] * x,
            ]
        )
        render = rendered(discs(scene.means.double().numpy(), turned, 0.2, 0.95))
        inner = torch.zeros(36, 48, dtype=torch.bool)
        inner[12:24, 16:32] = True
        losses.append(float(surface_loss(render, SurfaceWeights(normal=1.0), inner)))
    assert losses[0] < 0.01  # 1 - α²: the blended normals have the length α
    assert losses[1] > 0.05


def test_the_distortion_of_two_layers_is_that_of_their_weights_and_their_distance() -> None:
    front, back = np.array([[0.0, 0.0, 2.0]]), np.array([[0.0, 0.0, 2.5]])
    model = discs(np.concatenate([front, back]), np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)), 1e3, 0.5)
    render = rendered(model)
    loss = surface_loss(render, SurfaceWeights(distortion=3.0), None)
    assert float(loss) == pytest.approx(3.0 * 2 * 0.5 * 0.25 * 0.5, rel=1e-4)


def test_a_thread_one_pixel_wide_has_finite_gradients() -> None:
    z = np.linspace(-0.3, 0.3, 12)
    means = np.column_stack([np.full(12, 0.01), z, np.full(12, 2.0)])
    model = discs(means, np.tile([1.0, 0.0, 0.0, 0.0], (12, 1)), 1e-4, 0.9)
    leaves = [tensor.requires_grad_() for tensor in (model.means, model.quats, model.opacity_logits)]
    loss = surface_loss(rendered(model), BOTH, None)
    loss.backward()
    assert torch.isfinite(loss)
    assert all(leaf.grad is not None and torch.isfinite(leaf.grad).all() for leaf in leaves)


def test_pixels_that_are_not_trained_on_do_not_count_and_gaussians_have_no_such_loss() -> None:
    scene = wall(torch.from_numpy(so3_exp([0.4, 0.1, 0.0])))
    render = rendered(discs(scene.means.double().numpy(), scene.quats.double().numpy(), 0.2, 0.95))
    assert float(surface_loss(render, BOTH, torch.zeros(36, 48, dtype=torch.bool))) == 0
    with pytest.raises(InputError, match="3D Gaussians"):
        surface_loss(replace(render, surfels=None), BOTH, None)

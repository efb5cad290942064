"""One view of a map: surfels by 2D Gaussian splatting, all others by 3D."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import so3_exp
from splatbot.rasterize.maps import render_map
from splatbot.rasterize.views import render_view
from tests.models import random_model
from tests.scenes import FORWARD_BOUND
from tests.surfels import hard_surfels, reference, wall

pytestmark = pytest.mark.usefixtures("one_torch_thread", "default_kernels")


def test_surfels_have_the_images_of_the_float64_reference() -> None:
    scene = hard_surfels(3)
    model = GaussianModel.from_activated(
        means=scene.means,
        quats=scene.quats,
        scales=scene.scales * torch.tensor([1.0, 1.0, 0.0]),
        opacities=scene.opacities.clamp(0, 1),
        colors=scene.colors.clamp(0, 1),
    )
    scene.scales, scene.opacities = model.scales, model.opacities
    assert scene.backgrounds is not None
    exact, meta = reference(scene.to(torch.float64), "RGB+ED", distloss=True)
    render = render_map(
        model,
        scene.viewmats[0],
        scene.Ks[0],
        scene.width,
        scene.height,
        features=scene.colors,
        background=scene.backgrounds[0],
        render_mode="RGB+ED",
        distortion=True,
    )
    safe = (meta.margins > 2e-5)[0, ..., None]
    assert render.surfels is not None
    assert render.surfels.distortion is not None
    images = {"colors": render.image, "alphas": render.alpha, "normals": render.surfels.normals}
    images |= {"median": render.surfels.median, "distortion": render.surfels.distortion}
    for name, image in images.items():
        difference = ((exact[name][0] - image.double()).abs() * safe).max()
        assert difference <= (5 * FORWARD_BOUND if name in ("colors", "median", "distortion") else FORWARD_BOUND), name


def test_a_wall_of_surfels_has_the_depth_and_the_normal_of_its_plane() -> None:
    tilt = torch.from_numpy(so3_exp([0.5, -0.3, 0.2]))
    scene = wall(tilt)
    model = GaussianModel.from_activated(
        means=scene.means,
        quats=scene.quats,
        scales=scene.scales * torch.tensor([1.0, 1.0, 0.0]),
        opacities=scene.opacities,
        colors=scene.colors,
    )
    camera = Camera(40.0, 40.0, scene.width / 2 - 0.5, scene.height / 2 - 0.5, scene.width, scene.height)
    depth, normals = (render_view(model, camera, np.eye(4), mode) for mode in ("depth", "normal"))
    normal = tilt[:, 2].numpy() * -math.copysign(1.0, float(tilt[2, 2]))
    rays = camera.backproject(np.ones((scene.height, scene.width)))
    known = depth > 0
    assert known.mean() > 0.5
    np.testing.assert_allclose(depth[known], (2 * normal[2] / (rays @ normal))[known], rtol=1e-4)
    np.testing.assert_allclose(normals[known], np.broadcast_to(normal, normals.shape)[known], atol=1e-4)


def test_a_view_of_gaussians_has_no_images_of_surfels_and_of_surfels_no_antialiasing(rng: np.random.Generator) -> None:
    model, K = random_model(30, rng), torch.tensor([[40.0, 0, 24], [0, 40, 18], [0, 0, 1]])
    assert render_map(model, torch.eye(4), K, 48, 36).surfels is None
    with pytest.raises(InputError, match="antialiased"):
        render_map(model, torch.eye(4), K, 48, 36, surfels=True, antialiased=True)


def test_an_empty_map_of_surfels_shows_the_background() -> None:
    K, background = torch.tensor([[40.0, 0, 24], [0, 40, 18], [0, 0, 1]]), torch.tensor([0.2, 0.4, 0.6])
    render = render_map(
        GaussianModel.empty(), torch.eye(4), K, 48, 36, background=background, render_mode="RGB+ED", surfels=True
    )
    assert torch.equal(render.image[..., :3], background.expand(36, 48, 3))
    assert not render.image[..., 3].any()

"""Importance is the sum of blend weights: one-hot colours of the float64 reference are the oracle."""

from __future__ import annotations

import numpy as np
import torch

from splatbot.camera import Camera
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse
from splatbot.optimize.importance import blended_weights
from splatbot.rasterize import Gaussians, Viewpoints, rasterization_reference
from tests.models import random_model

CAMERA = Camera(30.0, 30.0, 19.5, 14.5, 40, 30)


def reference_weights(model: GaussianModel, T_world_camera: np.ndarray) -> torch.Tensor:
    gaussians = Gaussians(
        model.means.double(),
        model.quats.double(),
        model.scales.double(),
        model.opacities.double(),
        torch.eye(len(model), dtype=torch.float64),
    )
    viewmats, Ks = torch.from_numpy(inverse(T_world_camera))[None], torch.from_numpy(CAMERA.K_corner)[None]
    images, *_ = rasterization_reference(gaussians, Viewpoints(viewmats, Ks, CAMERA.width, CAMERA.height))
    return images[0].sum((0, 1))


def test_weights_are_those_of_the_float64_reference_summed_over_views() -> None:
    model = random_model(12, np.random.default_rng(0), least=0.05)
    near, far = np.eye(4), np.eye(4)
    near[2, 3], far[:3, 3] = -4.0, (0.5, 0.0, -5.0)
    expected = reference_weights(model, near) + reference_weights(model, far)
    found = blended_weights(model, [(CAMERA, near), (CAMERA, far)])
    torch.testing.assert_close(found.double(), expected, rtol=1e-3, atol=1e-3)
    assert found.max() > 5.0


def test_a_gaussian_that_no_view_shows_has_no_importance() -> None:
    model = random_model(5, np.random.default_rng(0))
    behind = np.eye(4)
    behind[2, 3] = 100.0
    assert not blended_weights(model, [(CAMERA, behind)]).any()

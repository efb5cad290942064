"""Importance of Gaussians for the images of a map."""

from __future__ import annotations

from collections.abc import Iterable

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatbot.camera import Camera
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse
from splatbot.rasterize import rasterization


def blended_weights(model: GaussianModel, views: Iterable[tuple[Camera, NDArray[np.float64]]]) -> Tensor:
    """Sum the blend weights (alpha times transmittance) of each Gaussian over the pixels of views, (N,) [px].

    Mini-Splatting (Fang, Wang 2024) ranks Gaussians by this sum. LightGaussian (Fan et al. 2024) adds a factor for the
    volume, and Speedy-Splat (Hanson et al. 2025) uses squared gradients instead. An image is the sum of colours times
    weights. So the gradient of the sum of its pixels to a colour is the sum of the weights.

    Args:
        model: the map.
        views: camera without distortion, and T_world_camera (4, 4), of each view.
    """
    weights = torch.zeros(len(model))
    opacities, scales = model.opacities, model.scales
    for camera, T_world_camera in views:
        colors = torch.ones(len(model), 1, requires_grad=True)
        image, _, _ = rasterization(
            model.means,
            model.quats,
            scales,
            opacities,
            colors,
            torch.as_tensor(inverse(T_world_camera), dtype=torch.float64)[None],
            torch.as_tensor(camera.K_corner, dtype=torch.float64)[None],
            camera.width,
            camera.height,
        )
        (gradient,) = torch.autograd.grad(image.sum(), [colors])
        weights += gradient[:, 0]
    return weights

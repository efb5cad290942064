"""Insertion: new Gaussians where the map does not explain a keyframe, and renderings of the map to compare with."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatbot.camera import Camera
from splatbot.config import MappingConfig
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, rotation_to_quat
from splatbot.mapping.keyframes import Keyframe
from splatbot.mapping.normals import fitted_normals
from splatbot.rasterize import rasterization


@dataclass(frozen=True)
class ModelView:
    """The map rendered from a pose: color (H, W, 3), depth (H, W) [m], alpha (H, W)."""

    rgb: Tensor
    depth: Tensor
    alpha: Tensor


@torch.no_grad()
def view_of(model: GaussianModel, camera: Camera, T_world_camera: NDArray[np.float64]) -> ModelView:
    """Render the map; depth is that of the Gaussians' planes, which avoids the bias of centers on slanted surfaces."""
    if len(model) == 0:
        blank = torch.zeros(camera.height, camera.width)
        return ModelView(blank[..., None].repeat(1, 1, 3), blank, blank.clone())
    renders, alphas, _ = rasterization(
        model.means,
        model.quats,
        model.scales,
        model.opacities,
        model.colors,
        torch.from_numpy(inverse(T_world_camera))[None],
        torch.from_numpy(camera.K_corner)[None],
        camera.width,
        camera.height,
        render_mode="RGB+ED",
        depth_mode="plane",
    )
    return ModelView(renders[0, ..., :3], renders[0, ..., 3], alphas[0, ..., 0])


def model_depth(view: ModelView, measured: NDArray[np.float32], config: MappingConfig) -> NDArray[np.float32]:
    """Return depth (H, W) [m] to track against: the map's where it is opaque and agrees with the measured depth.

    One factor scales all of the map's depth to the measured depth. Gaussians scatter about a surface, and the nearer
    ones occlude the others. The rendered depth is therefore too small, by 0.9 mm at 1.3 m after a single observation,
    and would bias every pose that is aligned to it.
    """
    depth = view.depth.numpy()
    # Strictly less, hence false where no depth was measured: the map may hold a guessed Gaussian there.
    agrees = np.abs(depth - measured) < config.surface_depth_tolerance * measured
    opaque = (view.alpha.numpy() > config.reference_alpha) & agrees
    scale = _robust_mean(measured[opaque] / depth[opaque]) if opaque.any() else 1.0
    return np.where(opaque, scale * depth, measured).astype(np.float32)


def _robust_mean(values: NDArray[np.float32]) -> float:
    """Compute the mean of all values within 3 σ of the median of a subset: robust, with less variance than a median."""
    subset = values[::16]  # a median of all values is slow
    median = np.median(subset)
    spread = 1.4826 * np.median(np.abs(subset - median))  # σ of normal values
    return float(values[np.abs(values - median) <= 3 * spread].mean(dtype=np.float64))


def unexplained(view: ModelView, depth: Tensor, config: MappingConfig) -> Tensor:
    """Return the pixels (H, W) with measured depth where the map is transparent or farther."""
    measured = depth > 0
    empty = view.alpha < config.unexplained_alpha
    in_front = depth < view.depth - config.surface_depth_tolerance * depth
    return measured & (empty | in_front)


def guess_depth(depth: Tensor) -> Tensor:
    """Return the depth (H, W) [m] of the nearest measured pixel where none was measured; 0 elsewhere."""
    missing = (depth == 0).numpy()
    if missing.all() or not missing.any():
        return torch.zeros_like(depth)
    _, labels = cv2.distanceTransformWithLabels(
        missing.astype(np.uint8), cv2.DIST_L2, 5, labelType=cv2.DIST_LABEL_PIXEL
    )
    nearest = np.zeros(labels.max() + 1, np.float32)
    nearest[labels[~missing]] = depth.numpy()[~missing]
    return torch.from_numpy(np.where(missing, nearest[labels], 0).astype(np.float32))


def guessed_gaussians(view: ModelView, keyframe: Keyframe, config: MappingConfig) -> GaussianModel:
    """Create Gaussians where the sensor measured no depth and the map is empty; they only carry color.

    Their depth is a guess. They have no observation, and collision checks ignore them until a keyframe supports them.
    """
    guess = guess_depth(keyframe.depth)
    where = (guess > 0) & (view.alpha < config.unexplained_alpha)
    if keyframe.static_mask is not None:
        where &= keyframe.static_mask
    model = new_gaussians(replace(keyframe, depth=guess), where, config)
    model.observations.zero_()
    return model


def new_gaussians(keyframe: Keyframe, where: Tensor, config: MappingConfig) -> GaussianModel:
    """Create one flat Gaussian for each selected pixel on a grid of ``config.stride`` pixels.

    Its disc covers the grid's footprint on the surface. The standard deviations are σ = 0.5 stride · z / f across the
    slant, σ / cos θ (at most 3 σ) along it, and ``config.thickness`` · σ through the surface. A pixel without a fitted
    plane gets a disc that faces the camera.

    Args:
        where: (H, W) bool, selected pixels.
    """
    s = config.stride
    grid = torch.zeros_like(where)
    grid[s // 2 :: s, s // 2 :: s] = True
    selected = (where & grid).numpy()
    camera = keyframe.camera
    depth = keyframe.depth.numpy()
    points = camera.backproject(depth)[selected].astype(np.float64)
    rows, columns = np.nonzero(selected)
    normals = fitted_normals(depth, camera, rows, columns, reach=2 * s)
    toward = -points / np.linalg.norm(points, axis=1, keepdims=True)
    normals = np.where((normals**2).sum(1, keepdims=True) > 0.25, normals, toward)
    cosine = np.abs((normals * toward).sum(1)).clip(1 / 3, 1.0)
    across = 0.5 * s * points[:, 2] / camera.fx * config.footprint
    R_world_camera = keyframe.T_world_camera[:3, :3]
    scales = np.stack([across / cosine, across, across * config.thickness], axis=1)
    return _with_anchor(
        GaussianModel.from_activated(
            means=points @ R_world_camera.T + keyframe.T_world_camera[:3, 3],
            quats=_disc_quats(normals, toward, R_world_camera),
            scales=scales,
            opacities=np.full(len(points), config.initial_opacity),
            colors=keyframe.rgb.numpy()[selected] / 255.0,
        ),
        keyframe.number,
    )


def _disc_quats(
    normals: NDArray[np.float64], toward: NDArray[np.float64], R: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Compute quaternions (N, 4): z along the normal, x along the direction in which slant stretches the footprint."""
    x = toward - (toward * normals).sum(1, keepdims=True) * normals
    length = np.linalg.norm(x, axis=1, keepdims=True)
    spare = np.cross(normals, np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]]))
    spare /= np.linalg.norm(spare, axis=1, keepdims=True)
    x = np.where(length > 1e-3, x / np.maximum(length, 1e-12), spare)
    y = np.cross(normals, x)
    return rotation_to_quat(R @ np.stack([x, y, normals], axis=-1)) if len(x) else np.zeros((0, 4))


def _with_anchor(model: GaussianModel, number: int) -> GaussianModel:
    model.anchors.fill_(number)
    return model

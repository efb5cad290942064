"""A small scene whose photographs are renders of known Gaussians."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path

import cv2
import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, look_at
from splatbot.rasterize import rasterization
from splatbot.training.datasets import TrainingData, TrainingView

CAMERA = Camera(110.0, 110.0, 63.5, 47.5, 128, 96)


def true_model(n: int = 80) -> GaussianModel:
    """Return coloured Gaussians of 3 to 12 cm within a ball of 0.4 m."""
    rng = np.random.default_rng(5)
    directions = rng.normal(size=(n, 3))
    means = directions / np.linalg.norm(directions, axis=1, keepdims=True) * rng.uniform(0.2, 0.4, (n, 1))
    return GaussianModel.from_activated(
        means=means,
        quats=rng.normal(size=(n, 4)),
        scales=rng.uniform(0.03, 0.12, (n, 3)),
        opacities=rng.uniform(0.6, 0.95, n),
        colors=rng.uniform(0.05, 0.95, (n, 3)),
    )


def ring(count: int) -> list[NDArray[np.float64]]:
    """Return poses on a ring of 1.6 m around the ball, at two heights, looking at its centre."""
    angles = np.linspace(0, 2 * np.pi, count, endpoint=False)
    eyes = [np.array([1.6 * np.cos(a), 0.7 * (-1.0) ** i, 1.6 * np.sin(a)]) for i, a in enumerate(angles)]
    return [look_at(eye, np.zeros(3)) for eye in eyes]


def photograph(
    model: GaussianModel, T_world_camera: NDArray[np.float64]
) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
    """Return RGBA (H, W, 4) and depth (H, W) [m], 0 where the model is transparent."""
    renders, alphas, _ = rasterization(
        model.means, model.quats, model.scales, model.opacities, model.colors,
        torch.from_numpy(inverse(T_world_camera))[None], torch.from_numpy(CAMERA.K_corner)[None],
        CAMERA.width, CAMERA.height, render_mode="RGB+ED",
    )  # fmt: skip
    alpha = alphas[0, ..., 0].numpy()
    rgb = renders[0, ..., :3].numpy() / np.maximum(alpha, 1e-6)[..., None]
    rgba = np.rint(255 * np.clip(np.dstack([rgb, alpha]), 0, 1)).astype(np.uint8)
    return rgba, np.where(alpha > 0.5, renders[0, ..., 3].numpy(), 0).astype(np.float32)


def rendered_data(count: int = 16, *, points: int = 0, depth: bool = False) -> TrainingData:
    """Return photographs with alpha of the true model, with or without points near its means."""
    model = true_model()
    views = []
    for i, T in enumerate(ring(count)):
        rgba, z = photograph(model, T)
        read, read_depth = partial(np.copy, rgba), partial(np.copy, z) if depth else None
        views.append(TrainingView(f"{i:03d}", CAMERA, T, read, read_depth))
    rng = np.random.default_rng(6)
    rows = rng.integers(0, len(model), points)
    near = model.means.double().numpy()[rows] + rng.normal(scale=0.03, size=(points, 3))
    colors = np.rint(255 * model.colors.numpy()[rows]).astype(np.uint8)
    return TrainingData("blender", Path("rendered"), tuple(views), near, colors)


def write_blender_scene(folder: Path, count: int) -> Path:
    """Write a Blender scene of ``count`` photographs with alpha, and return its folder."""
    frames = []
    for view in rendered_data(count).views:
        cv2.imwrite(str(folder / f"{view.name}.png"), cv2.cvtColor(view.read(), cv2.COLOR_RGBA2BGRA))
        T = view.T_world_camera @ np.diag([1.0, -1.0, -1.0, 1.0])
        frames.append({"file_path": f"./{view.name}", "transform_matrix": T.tolist()})
    angle = 2 * np.arctan(0.5 * CAMERA.width / CAMERA.fx)
    (folder / "transforms_train.json").write_text(json.dumps({"camera_angle_x": float(angle), "frames": frames}))
    return folder

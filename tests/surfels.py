"""Renders of surfels and their comparison with the float64 reference, on the scenes of tests.scenes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from splatbot.rasterize import rasterization_2dgs, rasterization_2dgs_reference
from tests.scenes import Scene, hard_scene, relative_l2

IMAGES = ("colors", "alphas", "normals", "surf_normals", "distortion", "median")
NAMES = ("means", "quats", "scales", "opacities", "colors", "viewmats", "Ks", "backgrounds")
RENDERED = ("colors", "alphas", "normals", "distortion", "median")  # by the kernels; the others follow in torch


def hard_surfels(seed: int, n: int = 150, views: int = 1) -> Scene:
    """Return half of ``hard_scene`` with discs at most 30 times longer than wide; needles have their own bound."""
    scene = hard_scene(seed, n=n, views=views)
    scene.width, scene.height = scene.width // 2 + 1, scene.height // 2 + 1
    scene.Ks[:, :2] *= 0.5
    scene.scales[:, :2] = torch.maximum(scene.scales[:, :2], scene.scales[:, :2].amax(1, keepdim=True) / 30.0)
    return scene


def arguments(scene: Scene) -> dict[str, Any]:
    """Return the arguments of a render of surfels, which have no covariances."""
    return {name: value for name, value in vars(scene).items() if name != "covars"}


def render(scene: Scene, render_mode: str = "RGB", **options: Any) -> tuple[dict[str, Tensor], Any]:
    """Render images by name, through the native kernels, and meta."""
    *images, meta = rasterization_2dgs(**arguments(scene), render_mode=render_mode, **options)
    return {n: image for n, image in zip(IMAGES, images, strict=True) if image is not None}, meta


def reference(
    scene: Scene, render_mode: str = "RGB", *, sh_degree: int | None = None, **options: Any
) -> tuple[dict[str, Tensor], Any]:
    """Render through the reference, in the type of the scene."""
    given = scene.gaussians(sh_degree), scene.viewpoints
    *images, meta = rasterization_2dgs_reference(*given, render_mode=render_mode, **options)
    return {n: image for n, image in zip(IMAGES, images, strict=True) if image is not None}, meta


def loss(images: dict[str, Tensor], safe: Tensor, of: Sequence[str]) -> Tensor:
    """Return a random weighting of the pixels of some images, the same for every type."""
    total = torch.zeros((), dtype=images["colors"].dtype)
    for k, name in enumerate(of):
        if name in images:
            generator = torch.Generator().manual_seed(k)
            weights = torch.randn(images[name].shape, generator=generator) * safe
            total = total + (images[name] * weights.to(total.dtype)).sum()
    return total


@dataclass
class SurfelComparison:
    """Native against reference, over the pixels that rounding cannot throw over one of the model's jumps."""

    forward: dict[str, float]  # largest absolute difference by image
    gradients: dict[str, float]  # relative L2 by input
    near_jumps: int  # pixels left out
    pixels: int


def compare_surfels(
    scene: Scene, render_mode: str, *, of: Sequence[str] = RENDERED, jump_margin: float = 2e-5, **options: Any
) -> SurfelComparison:
    """Forward and gradients of a random loss on the images ``of``, from the same float32 inputs."""
    sides = []
    call: Callable[..., tuple[dict[str, Tensor], Any]]
    for call, dtype in ((reference, torch.float64), (render, torch.float32)):
        leaves = scene.to(dtype, requires_grad=True)
        sides.append((leaves, *call(leaves, render_mode, **options)))
    (exact, want, meta), (native, got, _) = sides
    assert set(want) == set(got)
    safe = (meta.margins > jump_margin)[..., None]
    for _, images, _ in sides:
        loss(images, safe, of).backward()
    gradients = {}
    for name in NAMES:
        leaf, exact_leaf = getattr(native, name), getattr(exact, name)
        if exact_leaf is not None and exact_leaf.grad is not None:
            gradients[name] = relative_l2(leaf.grad, exact_leaf.grad)
    forward = {n: float(((want[n] - got[n].double()).abs() * safe).detach().max()) for n in want}
    return SurfelComparison(forward, gradients, int((~safe).sum()), safe.numel())


def wall(tilt: Tensor, *, distance: float = 2.0, sigma: float = 0.2, size: tuple[int, int] = (48, 36)) -> Scene:
    """Return overlapping discs in a plane through (0, 0, distance) with the axes ``tilt`` (3, 3)."""
    steps = torch.arange(-12, 13) * (0.5 * sigma)
    v, u = torch.meshgrid(steps, steps, indexing="ij")
    flat = torch.stack([u, v, torch.zeros_like(u)], -1).reshape(-1, 3).double()
    means = (flat @ tilt.T + torch.tensor([0.0, 0.0, distance], dtype=torch.float64)).float()
    n = len(means)
    w = 0.5 * torch.sqrt(1.0 + tilt.diagonal().sum())
    axis = torch.stack([tilt[2, 1] - tilt[1, 2], tilt[0, 2] - tilt[2, 0], tilt[1, 0] - tilt[0, 1]]) / (4.0 * w)
    width, height = size
    return Scene(
        means=means,
        quats=torch.cat([w[None], axis]).float().repeat(n, 1),
        scales=torch.tensor([sigma, sigma, 1.0]).repeat(n, 1),
        opacities=torch.full((n,), 0.7),
        colors=torch.rand(n, 3, generator=torch.Generator().manual_seed(0)),
        viewmats=torch.eye(4)[None],
        Ks=torch.tensor([[[40.0, 0.0, width / 2], [0.0, 40.0, height / 2], [0.0, 0.0, 1.0]]]),
        width=width,
        height=height,
    )

"""Train with a bilateral grid for each photograph: `python -m experiments.bilateral_grids`.

A grid of 16x16x8 affine transforms (Wang et al. 2024) changes the colours of the map by place and luma, as in gsplat's
trainer. Photographs of a simulated floor have vignetting and tints. Other photographs with exact colours score the map.
"""

from __future__ import annotations

import argparse
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from splatbot.camera import Camera
from splatbot.geometry import look_at
from splatbot.optimize.adam import PARAMETERS, adam_step
from splatbot.optimize.losses import l1_dssim
from splatbot.rasterize.native import native
from splatbot.training.datasets import TrainingData, TrainingView
from splatbot.training.images import ImageCache
from splatbot.training.initialize import initial_model
from splatbot.training.options import TrainingOptions
from splatbot.training.rendering import render_photo
from splatbot.training.scoring import score_held_out, summary
from splatbot.training.surface import SurfaceWeights
from splatbot.training.trainer import BatchGradients, Trainer

COLUMNS, ROWS, LEVELS = 16, 16, 8
"""Cells of a grid along width, height and luma of an image, as in gsplat's trainer."""

WIDTH, HEIGHT, SIDE = 160, 120, 3.0  # [px], [m]
_LUMA = (0.299, 0.587, 0.114)  # ITU-R BT.601
_RATES = 1e-2, 1e-3  # at the start and at the end, those of exposures
_WARM_UP = 1 / 30  # share of the run in which the rate grows from 1 %, as in gsplat's trainer
_GAUSSIANS = 1200


class BilateralGrids:
    """Grids of transforms c ↦ A c + b of the map's colours to those of each of C photographs, estimated by Adam.

    A cell belongs to a part of the image and a range of luma, so that vignetting, local lighting and tone curves are
    possible. A colour change M of the map leaves all renders as they are if each cell undoes it. The mean transform of
    all photographs is therefore the identity. That of a photograph is the mean over its pixels at its last step. Cells
    without pixels do not count. A change over the image that all photographs share, such as vignetting,
    stays possible.

    Each photograph counts its own steps of Adam, as :class:`splatbot.training.exposures.ExposureTransforms` explains.

    Args:
        count: C, the number of photographs.
    """

    def __init__(self, count: int) -> None:
        identity = torch.eye(3, 4).reshape(12, 1, 1, 1).expand(12, LEVELS, ROWS, COLUMNS)
        self.cells = identity.repeat(count, 1, 1, 1, 1)
        """(C, 12, L, R, K) float32, [A | b] of each cell in rows, before ``shift`` is subtracted."""
        self.shift = torch.zeros(12, dtype=torch.float64)
        """(12,) float64, the deviation of the mean transform from the identity."""
        self.means = torch.eye(3, 4, dtype=torch.float64).reshape(12).repeat(count, 1)
        """(C, 12) float64, the mean transform of each photograph, before ``shift`` is subtracted."""
        self.first = torch.zeros_like(self.cells)
        self.second = torch.zeros_like(self.cells)
        self.steps = torch.zeros(count)

    def of_views(self, views: list[int]) -> Tensor:
        """Return the grids (B, 12, L, R, K) of photographs, copied."""
        return self.cells[views] - self.shift.float().reshape(12, 1, 1, 1)

    def step(self, views: list[int], gradients: Tensor, means: Tensor, rate: float) -> None:
        """Perform one step.

        Args:
            views: indices of the B photographs of the step; one may be there twice.
            gradients: (B, 12, L, R, K) of the loss to their grids.
            means: (B, 12) of their transforms over pixels, see :func:`sliced`.
            rate: of each value.
        """
        rows, places = torch.tensor(views).unique(return_inverse=True)
        names = ("cells", "first", "second")
        cells, first, second = (getattr(self, name)[rows] for name in names)
        steps = self.steps[rows]
        adam_step(
            {"grid": cells},
            {"grid": torch.zeros_like(cells).index_add_(0, places, gradients.float())},
            {"grid": first},
            {"grid": second},
            steps,
            torch.ones(len(rows), dtype=torch.bool),
            {"grid": rate},
            betas=(0.9, 0.999),
            eps=1e-15,
        )
        for name, values in zip(names, (cells, first, second), strict=True):
            getattr(self, name)[rows] = values
        self.steps[rows] = steps
        self.means[views] = means.double() + self.shift
        self.shift = self.means.mean(0) - torch.eye(3, 4, dtype=torch.float64).reshape(12)


def sliced(render: Tensor, alpha: Tensor, background: Tensor, grid: Tensor) -> tuple[Tensor, Tensor]:
    """Return a render (H, W, 3) with the colours that a grid gives it, and the mean transform (12,), weighted by α.

    The background keeps its colour. Where nothing is in view, the mean is the identity and has no gradient.

    With the map's part m = c - (1 - α) B of a pixel, the result is A m + α b + (1 - α) B. [A | b] is the trilinear
    interpolation of the grid at the pixel's place and the luma of m; beyond the outer cells it is theirs.

    Args:
        render: c, (H, W, 3).
        alpha: α, (H, W, 1).
        background: B, (3,).
        grid: (12, L, R, K).
    """
    height, width = render.shape[:2]
    behind = (1 - alpha) * background
    colors = render - behind
    luma = colors @ colors.new_tensor(_LUMA)
    x = ((torch.arange(width, dtype=render.dtype) + 0.5) / width).expand(height, width)
    y = ((torch.arange(height, dtype=render.dtype) + 0.5) / height)[:, None].expand(height, width)
    places = 2 * torch.stack([x, y, luma], -1)[None, None] - 1
    found = F.grid_sample(grid[None].to(render.dtype), places, "bilinear", "border", align_corners=True)
    transforms = found.reshape(3, 4, height, width)
    image = (transforms * torch.cat([colors, alpha], -1).permute(2, 0, 1)).sum(1).permute(1, 2, 0) + behind
    weights = alpha.detach().reshape(-1)
    total = weights.sum()
    mean = found.detach().reshape(12, -1) @ weights / total if total > 0 else torch.eye(3, 4).reshape(12).to(weights)
    return image, mean


def total_variation(grid: Tensor) -> Tensor:
    """Return the sum over the three axes of a grid (12, L, R, K) of the mean squared difference of neighbours."""
    variation = sum((grid.diff(dim=axis).square().mean() for axis in (1, 2, 3)), grid.new_zeros(()))
    return torch.as_tensor(variation)


def texture(xy: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the smooth colour (..., 3) of a floor at places (..., 2) [m], 0.2 to 0.8."""
    rng = np.random.default_rng(0)
    waves = rng.normal(size=(8, 2)) * np.linspace(1.0, 6.0, 8)[:, None]  # [rad/m]
    weights = rng.uniform(-1.0, 1.0, (8, 3))
    values = np.sin(xy @ waves.T + rng.uniform(0.0, 2 * np.pi, 8)) @ (weights / np.abs(weights).sum(0))
    return np.asarray(0.5 + 0.3 * values)


def floor(rows: int, *, falloff: float = 0.0, tint: float = 0.0, seed: int = 1) -> TrainingData:
    """Return photographs of a floor from rows of as many cameras 1.5 m above it.

    Args:
        rows: of cameras, over the middle of the floor.
        falloff: of the brightness with the squared distance from the centre of the image, whose mean is subtracted.
        tint: largest relative change of a channel of a photograph; the mean over the photographs is 0.
        seed: of directions and tints.
    """
    camera = Camera(0.75 * WIDTH, 0.75 * WIDTH, WIDTH / 2 - 0.5, HEIGHT / 2 - 0.5, WIDTH, HEIGHT)
    u, v = np.meshgrid((np.arange(WIDTH) + 0.5) / WIDTH * 2 - 1, (np.arange(HEIGHT) + 0.5) / HEIGHT * 2 - 1)
    squares = (u**2 + v**2) / 2
    local = 1 - falloff * (squares - squares.mean())
    rays = np.stack([u / 1.5, v / 1.5 * HEIGHT / WIDTH, np.ones_like(u)], -1)
    rng = np.random.default_rng(seed)
    tints = 1 + np.stack([rng.permutation(np.linspace(-tint, tint, rows * rows)) for _ in range(3)], 1)
    views = []
    for index in range(rows * rows):
        place = (np.array([index // rows, index % rows]) + 0.5) / rows * SIDE
        T = look_at(np.array([*place, 1.5]), np.array([*place + rng.uniform(-0.4, 0.4, 2), 0.0]))
        toward = rays @ T[:3, :3].T
        rgb = texture(place - 1.5 / toward[..., 2:] * toward[..., :2])
        image = np.rint(255 * (rgb * tints[index] * local[..., None]).clip(0, 1)).astype(np.uint8)
        views.append(TrainingView(f"{index:03d}", camera, T, partial(np.copy, image)))
    xy = np.random.default_rng(2).uniform(-0.4 * SIDE, 1.4 * SIDE, (1200, 2))
    points = np.column_stack([xy, np.zeros(1200)])
    return TrainingData("nerfstudio", Path("floor"), tuple(views), points, np.rint(255 * texture(xy)).astype(np.uint8))


class GridTrainer(Trainer):
    """Estimates a bilateral grid for each photograph.

    Args:
        data, options: of the training.
        smoothness: weight of the total variation of a grid; 10 in gsplat's trainer.
    """

    def __init__(self, data: TrainingData, options: TrainingOptions, smoothness: float) -> None:
        images = ImageCache(data.views)
        super().__init__(start_of(data, images), images, options, data.scene_extent)
        self.grids = BilateralGrids(len(images.views))
        self._smoothness, self._progress = smoothness, 0.0

    def _set_rates(self, progress: float) -> None:
        super()._set_rates(progress)
        self._progress = progress

    def _gradients(
        self, views: list[tuple[int, Tensor]], reduce: int, degree: int, weights: SurfaceWeights
    ) -> BatchGradients:
        n, indices = len(self.model), [index for index, _ in views]
        parameters = {name: getattr(self.model, name).requires_grad_(True) for name in PARAMETERS}
        grids = self.grids.of_views(indices).requires_grad_()
        loss, means = torch.zeros(1), torch.zeros(len(views), 12)
        seen = torch.zeros(len(views), n, dtype=torch.uint8)
        for row, (index, background) in enumerate(views):
            photo = self.images.photo(index, reduce)
            render = render_photo(self.model, photo, self.poses.viewmats[index], background, degree)
            colors, means[row] = sliced(render.image, render.alpha, background, grids[row])
            own = l1_dssim(colors.contiguous(), photo.over(background), self.options.dssim_weight)
            (own + self._smoothness * total_variation(grids[row])).backward()
            loss += own.detach() / len(views)
            seen[row] = render.meta["visibility"][0]
        assert grids.grad is not None
        first, last = _RATES
        rate = first * (last / first) ** self._progress * min(1.0, 0.01 + 0.99 * self._progress / _WARM_UP)
        self.grids.step(indices, grids.grad, means, rate)
        grads = {name: parameter.grad / len(views) for name, parameter in parameters.items()}
        for parameter in parameters.values():
            parameter.requires_grad_(False)
            parameter.grad = None
        return BatchGradients(loss, grads, None, None, None, seen, torch.zeros(0, n, 2))


def start_of(data: TrainingData, images: ImageCache) -> Any:
    """Return the Gaussians of the start."""
    return initial_model(data, images, most=_GAUSSIANS, seed=0)


def scores(data: TrainingData, steps: int, *, exposure: bool = False, smoothness: float | None = None) -> list[float]:
    """Train on all photographs; return PSNR and colour-corrected PSNR of others with exact colours [dB].

    Args:
        data: photographs.
        steps: of the training.
        exposure: estimate one transform for each photograph.
        smoothness: estimate bilateral grids with that weight of their total variation; None for no grids.
    """
    options = TrainingOptions(
        iterations=steps,
        strategy="fixed",
        sh_degree=0,
        max_gaussians=_GAUSSIANS,
        batch=2,
        coarse_share=0.0,
        exposure=exposure,
    )
    images = ImageCache(data.views)
    trainer = (
        Trainer(start_of(data, images), images, options, data.scene_extent)
        if smoothness is None
        else GridTrainer(data, options, smoothness)
    )
    for step in range(steps):
        trainer.step(step / steps)
    others = ImageCache(floor(3, seed=7).views)
    found = summary(score_held_out(trainer.model, others, options, data.scene_extent))
    return [float(found["psnr_db"]), float(found["corrected_psnr_db"])]


def main() -> None:
    """Print the scores of each kind of training, for photographs of changed and of exact colours."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--steps", type=int, default=500)
    args = parser.parse_args()
    torch.set_num_threads(1)
    native().set_num_threads(1)
    kinds: dict[str, dict[str, Any]] = {
        "as they are": {},
        "one transform each": {"exposure": True},
        "grids, total variation 10": {"smoothness": 10.0},
        "grids, total variation 100": {"smoothness": 100.0},
    }
    for colors, data in {"changed": floor(5, falloff=0.7, tint=0.15), "exact": floor(5)}.items():
        for name, kind in kinds.items():
            psnr, corrected = scores(data, args.steps, **kind)
            print(f"{colors} colours, {name}: {psnr:.1f} dB, colour-corrected {corrected:.1f} dB", flush=True)


if __name__ == "__main__":
    main()

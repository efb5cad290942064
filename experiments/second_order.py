"""Compare Gauss-Newton steps with Adam for training: `python -m experiments.second_order DATASET ...`.

All start from one map that is trained with Adam, and take one photograph a step. The loss of the second-order steps is
L = 1/M sum r^2 over the M values r of an image. Its Gauss-Newton matrix is H = 2/M J^T J. For signs v at random, the
product of g = sqrt(2/M) J^T v with itself has the mean H (Hutchinson 1990). So one further backward pass estimates the
blocks of H that belong to one Gaussian, as 3DGS^2 (Lan et al. 2025) uses. Adam has its usual loss, and this one.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from statistics import fmean

import torch
from torch import Tensor

from splatbot.gaussians import GaussianModel
from splatbot.optimize.adam import PARAMETERS
from splatbot.optimize.losses import l1_dssim
from splatbot.rasterize.native import native
from splatbot.training.datasets import open_dataset
from splatbot.training.images import ImageCache
from splatbot.training.initialize import initial_model
from splatbot.training.options import TrainingOptions
from splatbot.training.rendering import render_photo
from splatbot.training.scoring import score_held_out
from splatbot.training.trainer import CONSTANTS, Trainer

_GRADIENT_MEMORY = 0.9
_MATRIX_MEMORY = 0.98
_DAMPING = 0.1  # share of the mean diagonal of a block
_FLOOR = 1e-12
_LAST_RATE = 0.1  # share of the first
_LEAST_VIEWS = 5  # of a Gaussian before it moves: a matrix of fewer probes is no estimate
_LARGEST_STEP = 20.0  # of Adam's steps

Step = Callable[[GaussianModel, float], None]


@dataclass(frozen=True)
class Scene:
    """A map and the photographs to continue with.

    Args:
        start: the map after its training with Adam.
        images, held_out: photographs.
        options: of the training.
        extent: of the scene [m].
    """

    start: GaussianModel
    images: ImageCache
    held_out: ImageCache
    options: TrainingOptions
    extent: float

    def psnr(self, model: GaussianModel) -> float:
        """Return the mean PSNR of held-out views [dB]."""
        scores = score_held_out(model, self.held_out, self.options, self.extent, psnr_only=True)
        return fmean(score.psnr_db for score in scores)


def prepare(folder: Path, *, scale: int, gaussians: int, warm: int) -> Scene:
    """Train a map with Adam and the usual strategy for ``warm`` steps."""
    data = open_dataset(folder, scale=scale)
    train, held_out = data.split(8)
    options = TrainingOptions(strategy="mcmc", iterations=warm, max_gaussians=gaussians, sh_degree=1)
    images = ImageCache(train)
    start = initial_model(data, images, most=gaussians, seed=0, surfels=False)
    trainer = Trainer(start, images, options, data.scene_extent)
    for step in range(warm):
        trainer.step(step / warm)
    return Scene(trainer.model, images, ImageCache(held_out), options, data.scene_extent)


class Views:
    """Renders the photographs of a scene in a fixed random order."""

    def __init__(self, scene: Scene) -> None:
        self._images = scene.images
        self._viewmats = Trainer(scene.start, scene.images, scene.options, scene.extent).poses.viewmats
        self._random = torch.Generator().manual_seed(1)
        self._background = scene.options.shade

    def next(self, model: GaussianModel) -> tuple[Tensor, Tensor, Tensor]:
        """Return render (H, W, 3), photograph (H, W, 3), and the rows (N,) in view."""
        index = int(torch.randint(len(self._images.views), (1,), generator=self._random))
        photo = self._images.photo(index)
        render = render_photo(model, photo, self._viewmats[index], self._background, model.sh_degree)
        seen = render.meta["visibility"][0].bool()
        return render.image[..., :3].contiguous(), photo.over(self._background), seen


def adam_steps(scene: Scene, rate: float, *, squares: bool) -> Step:
    """Return steps of Adam with the rates of training times ``rate``; ``squares`` has the loss of Gauss-Newton."""
    trainer, views = Trainer(scene.start, scene.images, scene.options, scene.extent), Views(scene)
    rates = _adam_rates(scene)

    def step(model: GaussianModel, progress: float) -> None:
        parameters = _with_gradients(model)
        image, photograph, seen = views.next(model)
        loss = (image - photograph).square().mean() if squares else l1_dssim(image, photograph, 0.2, None)
        grads = torch.autograd.grad(loss, parameters)
        _without_gradients(parameters)
        decay = rate * _LAST_RATE**progress
        trainer.adam.rates = {name: decay * value for name, value in rates.items()}
        trainer.adam.step(model, dict(zip(PARAMETERS, grads, strict=True)), seen)

    return step


def gauss_newton_steps(scene: Scene, rate: float, *, blocks: bool) -> Step:
    """Return steps d = -rate (H + lambda)^-1 g with running means of g and H, in blocks or with the diagonal of H."""
    views, signs = Views(scene), torch.Generator().manual_seed(2)
    n = len(scene.start)
    gradient = {name: torch.zeros_like(getattr(scene.start, name)) for name in PARAMETERS}
    matrix = {name: torch.zeros(n, *_block(getattr(scene.start, name), blocks=blocks)) for name in PARAMETERS}
    seen_times, most = torch.zeros(n), _adam_rates(scene)

    def step(model: GaussianModel, progress: float) -> None:
        parameters = _with_gradients(model)
        image, photograph, seen = views.next(model)
        residual = (image - photograph).detach()
        scale = 2.0 / residual.numel()
        v = torch.randint(0, 2, residual.shape, generator=signs).float() * 2 - 1
        grads = torch.autograd.grad(image, parameters, scale * residual, retain_graph=True)
        probes = torch.autograd.grad(image, parameters, scale**0.5 * v)
        _without_gradients(parameters)
        rows = seen.nonzero()[:, 0]
        seen_times[rows] += 1
        decay = rate * _LAST_RATE**progress
        for name, grad, probe in zip(PARAMETERS, grads, probes, strict=True):
            g, h = gradient[name], matrix[name]
            outer = _outer(probe[rows], blocks=blocks)
            g[rows] = _GRADIENT_MEMORY * g[rows] + (1 - _GRADIENT_MEMORY) * grad[rows]
            h[rows] = _MATRIX_MEMORY * h[rows] + (1 - _MATRIX_MEMORY) * outer
            times = seen_times[rows]
            unbiased_g = g[rows] / _per_row(1 - _GRADIENT_MEMORY**times, g)
            unbiased_h = h[rows] / _per_row(1 - _MATRIX_MEMORY**times, h)
            limit = _LARGEST_STEP * most[name]
            change = (decay * _solve(unbiased_h, unbiased_g, blocks=blocks)).clamp(-limit, limit)
            getattr(model, name)[rows] -= change * _per_row(times >= _LEAST_VIEWS, g)

    return step


def _adam_rates(scene: Scene) -> dict[str, float]:
    c = CONSTANTS
    return {
        "means": c.means_rate[0] * scene.extent,
        "quats": c.quats_rate,
        "log_scales": c.scales_rate,
        "opacity_logits": c.opacities_rate,
        "sh": c.dc_rate,
    }


def _block(parameter: Tensor, *, blocks: bool) -> tuple[int, ...]:
    """Return the shape of a row of H: (K, K) for parameters of K values a Gaussian; harmonics keep the diagonal."""
    shape = tuple(parameter.shape[1:])
    return (*shape, *shape) if blocks and len(shape) == 1 else shape


def _outer(probe: Tensor, *, blocks: bool) -> Tensor:
    return probe[:, :, None] * probe[:, None, :] if blocks and probe.dim() == 2 else probe.square()


def _solve(h: Tensor, g: Tensor, *, blocks: bool) -> Tensor:
    """Solve (H + lambda I) d = g row by row; lambda is a share of the mean diagonal of the row."""
    if blocks and g.dim() == 2:
        diagonal = h.diagonal(dim1=1, dim2=2).mean(1)
        damped = h + (_DAMPING * diagonal + _FLOOR)[:, None, None] * torch.eye(g.shape[1])
        return torch.as_tensor(torch.linalg.solve(damped, g))
    mean = h.reshape(len(h), -1).mean(1)
    return g / (h + _per_row(_DAMPING * mean + _FLOOR, h))


def _per_row(values: Tensor, like: Tensor) -> Tensor:
    return values.reshape(-1, *(1 for _ in like.shape[1:]))


def _with_gradients(model: GaussianModel) -> list[Tensor]:
    return [getattr(model, name).requires_grad_(True) for name in PARAMETERS]


def _without_gradients(parameters: Sequence[Tensor]) -> None:
    for parameter in parameters:
        parameter.requires_grad_(False)


def run(scene: Scene, step: Step, seconds: float) -> tuple[list[float], int]:
    """Take steps for that processor time [s]; return PSNR at its quarters [dB], and the number of steps."""
    model = scene.start.clone()
    spent, steps = 0.0, 0
    scores: list[float] = []
    while spent < seconds:
        begin = time.process_time()
        step(model, spent / seconds)
        spent += time.process_time() - begin
        steps += 1
        while len(scores) < 4 and spent >= seconds * (len(scores) + 1) / 4:
            scores.append(scene.psnr(model))
    return scores, steps


def main() -> None:
    """Print the held-out PSNR of each kind of step and rate, at quarters of the time."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--gaussians", type=int, default=20_000)
    parser.add_argument("--warm", type=int, default=600)
    parser.add_argument("--seconds", type=float, default=60.0)
    args = parser.parse_args()
    torch.set_num_threads(1)
    native().set_num_threads(1)
    scene = prepare(args.dataset, scale=args.scale, gaussians=args.gaussians, warm=args.warm)
    print(f"start: {len(scene.start)} Gaussians, {scene.psnr(scene.start):.2f} dB on {len(scene.held_out.views)} views")
    kinds: list[tuple[str, Callable[[float], Step], tuple[float, ...]]] = [
        ("Adam, L1 + D-SSIM", lambda rate: adam_steps(scene, rate, squares=False), (0.5, 1.0, 2.0)),
        ("Adam, squares", lambda rate: adam_steps(scene, rate, squares=True), (0.5, 1.0, 2.0)),
        ("Gauss-Newton, diagonal", lambda rate: gauss_newton_steps(scene, rate, blocks=False), (0.003, 0.01, 0.02)),
        ("Gauss-Newton, blocks", lambda rate: gauss_newton_steps(scene, rate, blocks=True), (0.003, 0.01, 0.02)),
    ]
    for name, make, rates in kinds:
        for rate in rates:
            scores, steps = run(scene, make(rate), args.seconds)
            shown = "  ".join(f"{score:6.2f}" for score in scores)
            print(f"{name:24} rate {rate:5.3f}: {shown} dB, {steps} steps", flush=True)


if __name__ == "__main__":
    main()

"""Compare steps of training at equal processor time: `python -m experiments.training_steps DATASET --kinds views`.

"views" compares one view a step with several. These have a call each, or one call for all. Near views also share
their evaluation of harmonics. "tiles" compares whole images with steps that leave out tiles whose loss is below a share
of the mean, or a half of the tiles. That half is drawn at random, or with a probability proportional to the loss.
A Gaussian without a gradient then takes no step. All have the same seeds, images and strategy (mcmc).
"""

from __future__ import annotations

import argparse
import math
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from statistics import fmean, stdev

import torch
import torch.nn.functional as F
from torch import Tensor

from splatbot.gaussians import GaussianModel
from splatbot.optimize.adam import PARAMETERS
from splatbot.optimize.losses import l1_dssim
from splatbot.optimize.strategies import MCMCStrategy
from splatbot.rasterize import rasterization
from splatbot.rasterize.harmonics import harmonics_basis
from splatbot.rasterize.meta import RenderMeta
from splatbot.rasterize.native import native
from splatbot.rasterize.work import raster_work
from splatbot.training.datasets import TrainingData, open_dataset
from splatbot.training.images import ImageCache
from splatbot.training.initialize import initial_model
from splatbot.training.options import TrainingOptions
from splatbot.training.scoring import score_held_out
from splatbot.training.surface import SurfaceWeights
from splatbot.training.trainer import BatchGradients, Trainer

_TILE = 32  # [px] side of a tile that is left out
_WHOLE_EVERY = 4  # visits of a view, of which one renders all tiles
_LEAST_PROBABILITY = 0.1  # of a tile that is drawn by its loss
_REDUCTIONS = 1, 2, 4


@dataclass(frozen=True)
class Scene:
    """Photographs to train on.

    Args:
        data: the dataset.
        images, held_out: photographs, read.
        options: of the training, with the cap.
    """

    data: TrainingData
    images: ImageCache
    held_out: ImageCache
    options: TrainingOptions

    def options_of(self, seed: int, batch: int) -> TrainingOptions:
        """Return the options with a seed and a number of views a step."""
        return replace(self.options, seed=seed, batch=batch)

    def start(self, seed: int) -> GaussianModel:
        """Return the Gaussians of the start."""
        most = self.options.max_gaussians
        assert most is not None
        return initial_model(self.data, self.images, most=most, seed=seed, surfels=False)


class CallsTrainer(Trainer):
    """Renders each view of a step in a call of its own, as `splatbot train --batch N` does.

    The strategy changes the Gaussians after the same number of views, for any number of views a step.
    """

    def __init__(self, scene: Scene, seed: int, batch: int, *, rate: float = 1.0) -> None:
        self._rate = rate  # factor of all learning rates
        super().__init__(scene.start(seed), scene.images, scene.options_of(seed, batch), scene.data.scene_extent)
        strategy = self.strategy
        assert isinstance(strategy, MCMCStrategy)
        self.strategy = replace(
            strategy,
            refine_every=strategy.refine_every // batch,
            refine_start_iter=strategy.refine_start_iter // batch,
        )

    def _set_rates(self, progress: float) -> None:
        super()._set_rates(progress)
        self.adam.rates = {
            name: rate * self._rate if isinstance(rate, float) else [self._rate * value for value in rate]
            for name, rate in self.adam.rates.items()
        }


class OneCallTrainer(CallsTrainer):
    """Renders all views of a step in one call."""

    def _gradients(
        self, views: list[tuple[int, Tensor]], reduce: int, degree: int, weights: SurfaceWeights
    ) -> BatchGradients:
        indices, backgrounds = [index for index, _ in views], torch.stack([background for _, background in views])
        photos = [self.images.photo(index, reduce) for index in indices]
        targets = torch.stack([photo.over(background) for photo, background in zip(photos, backgrounds, strict=True)])
        parameters = _with_gradients(self.model)
        colors, of_harmonics = self._colors(indices, degree)
        renders, _, meta = rasterization(
            self.model.means, self.model.quats, self.model.scales, self.model.opacities, colors,
            self.poses.viewmats[indices], torch.stack([torch.from_numpy(p.camera.K_corner) for p in photos]),
            photos[0].camera.width, photos[0].camera.height, sh_degree=of_harmonics, backgrounds=backgrounds,
        )  # fmt: skip
        loss = l1_dssim(renders, targets, self.options.dssim_weight)
        return _gradients_of(loss, parameters, meta)

    def _colors(self, indices: list[int], degree: int) -> tuple[Tensor, int | None]:
        """Return the colours of the Gaussians, and the degree of the harmonics that they are coefficients of."""
        return self.model.sh, degree


class NearViewsTrainer(OneCallTrainer):
    """Renders a view and those nearest to it in one call, with the harmonics of their mean direction."""

    def __init__(self, scene: Scene, seed: int, batch: int) -> None:
        super().__init__(scene, seed, batch)
        centers = torch.stack([torch.from_numpy(view.T_world_camera[:3, 3]) for view in scene.images.views])
        self._centers = centers.float()
        self._nearest = torch.cdist(centers, centers).argsort(dim=1, stable=True)[:, :batch]
        self._queue: list[int] = []

    def _next_view(self) -> int:
        if not self._queue:
            self._queue = self._nearest[super()._next_view()].tolist()
        return self._queue.pop(0)

    def _colors(self, indices: list[int], degree: int) -> tuple[Tensor, int | None]:
        directions = F.normalize(self.model.means.detach() - self._centers[indices].mean(0), dim=1)
        basis = harmonics_basis(directions, degree)[..., None]
        return (0.5 + (basis * self.model.sh[:, : basis.shape[1]]).sum(1)).clamp_min(0.0), None


TileRule = Callable[[Tensor, torch.Generator], Tensor]
"""Selects tiles (R, C) bool by their last known losses (R, C) and random draws."""


class TilesTrainer(CallsTrainer):
    """Renders the tiles of a view that a rule selects; at times, all.

    Args:
        scene, seed: see :class:`CallsTrainer`.
        rule: selects tiles.
        counts_all: whether the loss is a sum over the selected tiles in units of the whole image, not their mean.
    """

    def __init__(self, scene: Scene, seed: int, rule: TileRule, *, counts_all: bool) -> None:
        super().__init__(scene, seed, 1)
        self._rule, self._counts_all = rule, counts_all
        self._losses: dict[tuple[int, int], Tensor] = {}
        self._visits = [0] * len(scene.images.views)
        self._draws = torch.Generator().manual_seed(seed)
        self.rendered: list[float] = []

    def _gradients(
        self, views: list[tuple[int, Tensor]], reduce: int, degree: int, weights: SurfaceWeights
    ) -> BatchGradients:
        ((index, background),) = views
        photo = self.images.photo(index, reduce)
        width, height = photo.camera.width, photo.camera.height
        shape = -(-height // _TILE), -(-width // _TILE)
        losses = self._losses.get((index, reduce))
        whole = losses is None or self._visits[index] % _WHOLE_EVERY == 0
        self._visits[index] += 1
        kept = torch.ones(shape, dtype=torch.bool) if losses is None or whole else self._rule(losses, self._draws)
        pixels = kept.repeat_interleave(_TILE, 0).repeat_interleave(_TILE, 1)[:height, :width]
        counted = pixels if photo.trained is None else pixels & photo.trained
        parameters = _with_gradients(self.model)
        renders, _, meta = rasterization(
            self.model.means, self.model.quats, self.model.scales, self.model.opacities, self.model.sh,
            self.poses.viewmats[[index]], torch.from_numpy(photo.camera.K_corner)[None], width, height,
            sh_degree=degree, backgrounds=background[None], masks=kept[None], tile_size=_TILE,
        )  # fmt: skip
        target = photo.over(background)
        share = float(pixels.float().mean())
        loss = l1_dssim(renders[0], target, self.options.dssim_weight, None if bool(counted.all()) else counted)
        self.rendered.append(share)
        found = _gradients_of(loss * share if self._counts_all else loss, parameters, meta)
        errors = _tile_means((renders[0].detach() - target).abs().mean(-1))
        self._losses[index, reduce] = errors if losses is None else torch.where(kept, errors, losses)
        return replace(found, seen=found.seen * (found.grads["opacity_logits"] != 0))


def below_mean(share: float) -> TileRule:
    """Return the rule that leaves out tiles whose loss is below a share of the mean."""
    return lambda losses, draws: losses >= share * losses.mean()


def at_random(share: float) -> TileRule:
    """Return the rule that keeps each tile with that probability."""
    return lambda losses, draws: torch.rand(losses.shape, generator=draws) < share


def by_loss(share: float) -> TileRule:
    """Return the rule that keeps a tile with a probability proportional to its loss, ``share`` at the mean."""
    return lambda losses, draws: (
        torch.rand(losses.shape, generator=draws) < (share * losses / losses.mean()).clamp(_LEAST_PROBABILITY, 1.0)
    )


def _tile_means(errors: Tensor) -> Tensor:
    """Return the means (R, C) of errors (H, W) over tiles."""
    return F.avg_pool2d(errors[None], _TILE, ceil_mode=True, count_include_pad=False)[0]


def _with_gradients(model: GaussianModel) -> dict[str, Tensor]:
    return {name: getattr(model, name).requires_grad_(True) for name in PARAMETERS}


def _gradients_of(loss: Tensor, parameters: dict[str, Tensor], meta: RenderMeta) -> BatchGradients:
    """Return the gradients of a loss to the parameters, which need none afterwards."""
    found = torch.autograd.grad(loss, list(parameters.values()))
    for parameter in parameters.values():
        parameter.requires_grad_(False)
    grads = {name: grad.contiguous() for name, grad in zip(parameters, found, strict=True)}
    seen = meta["visibility"].to(torch.uint8)
    return BatchGradients(loss.detach()[None], grads, None, None, None, seen, torch.zeros(0, seen.shape[1], 2))


Make = Callable[[Scene, int], CallsTrainer]
"""Returns a trainer of a scene and a seed."""

KINDS: dict[str, dict[str, Make]] = {
    "views": {
        "1 view": lambda scene, seed: CallsTrainer(scene, seed, 1),
        "4 views, a call each": lambda scene, seed: CallsTrainer(scene, seed, 4),
        "4 views, a call each, rates x2": lambda scene, seed: CallsTrainer(scene, seed, 4, rate=2.0),
        "4 views, one call": lambda scene, seed: OneCallTrainer(scene, seed, 4),
        "4 views, one call, rates x2": lambda scene, seed: OneCallTrainer(scene, seed, 4, rate=2.0),
        "4 near views, shared harmonics": lambda scene, seed: NearViewsTrainer(scene, seed, 4),
    },
    "tiles": {
        "whole images": lambda scene, seed: CallsTrainer(scene, seed, 1),
        "without tiles below 1/4 of the mean": lambda s, seed: TilesTrainer(s, seed, below_mean(0.25), counts_all=True),
        "without tiles below 1/2 of the mean": lambda s, seed: TilesTrainer(s, seed, below_mean(0.5), counts_all=True),
        "a half of the tiles at random": lambda s, seed: TilesTrainer(s, seed, at_random(0.5), counts_all=False),
        "a half of the tiles by loss": lambda s, seed: TilesTrainer(s, seed, by_loss(0.5), counts_all=False),
    },
}


def open_scene(folder: Path, *, scale: int, gaussians: int, background: str) -> Scene:
    """Open a dataset, and read all photographs in the sizes of a training.

    Args:
        folder: of the dataset.
        scale: factor by which the images are reduced.
        gaussians: largest number.
        background: "black" or "white".
    """
    data = open_dataset(folder, scale=scale)
    train, held_out = (ImageCache(views) for views in data.split(8))
    for index in range(len(train.views)):
        for reduce in _REDUCTIONS:
            train.photo(index, reduce)
    options = TrainingOptions(
        strategy="mcmc", max_gaussians=gaussians, background="white" if background == "white" else "black"
    )
    return Scene(data, train, held_out, options)


def run(scene: Scene, trainer: CallsTrainer, seconds: float) -> list[float]:
    """Train for that processor time [s]; return the PSNR of held-out views at its half and its end [dB]."""
    spent = 0.0
    scores: list[float] = []
    while spent < seconds:
        begin = time.process_time()
        trainer.step(spent / seconds)
        spent += time.process_time() - begin
        while len(scores) < 2 and spent >= seconds * (len(scores) + 1) / 2:
            found = score_held_out(
                trainer.model, scene.held_out, trainer.options, scene.data.scene_extent, psnr_only=True
            )
            scores.append(fmean(score.psnr_db for score in found))
    return scores


def stage_times(trainer: CallsTrainer) -> dict[str, float]:
    """Return the mean times of the stages of a view's render, and of a whole step with one view [ms]."""
    scene_views = range(len(trainer.images.views))
    sums: dict[str, float] = {}
    for index in scene_views:
        parameters = _with_gradients(trainer.model)
        photo = trainer.images.photo(index)
        renders, _, meta = rasterization(
            trainer.model.means, trainer.model.quats, trainer.model.scales, trainer.model.opacities, trainer.model.sh,
            trainer.poses.viewmats[[index]], torch.from_numpy(photo.camera.K_corner)[None],
            photo.camera.width, photo.camera.height, sh_degree=trainer.model.sh_degree,
        )  # fmt: skip
        _gradients_of(l1_dssim(renders[0], photo.over(trainer.options.shade)), parameters, meta)
        for name, value in vars(raster_work(meta)[0]).items():
            if name.endswith("_ms"):
                sums[name] = sums.get(name, 0.0) + value / len(scene_views)
    begin = time.process_time()
    for _ in scene_views:
        trainer.step(1.0)
    return {**sums, "step_ms": 1e3 * (time.process_time() - begin) / len(scene_views)}


def main() -> None:
    """Print the held-out PSNR of each kind of step at half and all of the time, the spread over seeds, and the work."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("dataset", type=Path)
    parser.add_argument("--kinds", choices=tuple(KINDS), required=True)
    parser.add_argument("--scale", type=int, default=4)
    parser.add_argument("--gaussians", type=int, default=30_000)
    parser.add_argument("--background", choices=("black", "white"), default="black")
    parser.add_argument("--seconds", type=float, default=40.0)
    parser.add_argument("--seeds", type=int, nargs="+", default=[0, 1, 2])
    args = parser.parse_args()
    torch.set_num_threads(1)
    native().set_num_threads(1)
    scene = open_scene(args.dataset, scale=args.scale, gaussians=args.gaussians, background=args.background)
    scores: dict[str, list[list[float]]] = {name: [] for name in KINDS[args.kinds]}
    for seed in args.seeds:
        for name, make in KINDS[args.kinds].items():
            trainer = make(scene, seed)
            scores[name].append(run(scene, trainer, args.seconds))
            half, end = scores[name][-1]
            views = trainer.iteration * trainer.options.batch
            work = f"{views} views, {1e3 * args.seconds / views:.1f} ms each, {len(trainer.model)} Gaussians"
            tiles = (
                f", {100 * fmean(trainer.rendered):.0f} % of the pixels" if isinstance(trainer, TilesTrainer) else ""
            )
            print(f"seed {seed}  {name:36} {half:6.2f} {end:6.2f} dB, {work}{tiles}", flush=True)
            if seed == args.seeds[0] and name == next(iter(scores)):
                print("  ".join(f"{key} {value:.2f}" for key, value in stage_times(trainer).items()), flush=True)
    for name, found in scores.items():
        ends = [end for _, end in found]
        spread = stdev(ends) if len(ends) > 1 else math.nan
        print(f"{name:36} {fmean(half for half, _ in found):6.2f} {fmean(ends):6.2f} dB, spread {spread:.2f} dB")


if __name__ == "__main__":
    main()

"""Training: Adam on all Gaussians of a scene, one or more photographs a step."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from types import SimpleNamespace
from typing import Any

import torch
from torch import Tensor

from splatbot.config import MappingConfig
from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import shortest_axes
from splatbot.gaussians.surfels import as_surfels, flatten
from splatbot.optimize.adam import PARAMETERS, GaussianAdam
from splatbot.optimize.losses import l1_dssim, relative_depth_error
from splatbot.optimize.strategies import StrategyStep
from splatbot.optimize.strategies.edits import grow_harmonics
from splatbot.optimize.surfaces import limit_normal_motion, limit_shape
from splatbot.rasterize.maps import MapRender
from splatbot.rasterize.native import one_torch_thread
from splatbot.training.distributed import ALONE, TrainingGroup
from splatbot.training.exposures import ExposureTransforms, exposed
from splatbot.training.images import ImageCache, Photo
from splatbot.training.intrinsics import CameraIntrinsics, matrix, prior
from splatbot.training.options import TrainingOptions
from splatbot.training.poses import CameraPoses
from splatbot.training.rendering import render_photo
from splatbot.training.surface import SurfaceWeights, surface_loss

_MAPPING = MappingConfig()
_OF_VIEWS = {
    "poses": ("viewmats", "first", "second", "steps"),
    "intrinsics": ("changes", "first", "second", "steps"),
    "exposures": ("transforms", "first", "second", "steps"),
}
"""Values of views that training can estimate, with the names of their state."""


@dataclass(frozen=True)
class TrainerConstants:
    """Constants of training; learning rates are those of Kerbl et al. 2023.

    Args:
        means_rate: at the start and at the end [share of the scene's extent]; exponential in between.
        quats_rate, scales_rate, opacities_rate, dc_rate: constant rates of the other parameters.
        rest_share: rate of the higher harmonics [share of ``dc_rate`` ].
        pose_rate: at the start and at the end [rad]; exponential in between.
        intrinsics_rate: of relative changes, at the start and at the end; exponential in between.
        exposure_rate: at the start and at the end; exponential in between (Kerbl et al. 2024).
        harmonics_share: share of the run after which the harmonics have their final degree.
        covered_alpha: depth counts where the map covers a pixel more.
    """

    means_rate: tuple[float, float] = (1.6e-4, 1.6e-6)
    quats_rate: float = 1e-3
    scales_rate: float = 5e-3
    opacities_rate: float = 5e-2
    dc_rate: float = 2.5e-3
    rest_share: float = 1 / 20
    pose_rate: tuple[float, float] = (2e-3, 2e-5)
    intrinsics_rate: tuple[float, float] = (2e-3, 2e-5)
    exposure_rate: tuple[float, float] = (1e-2, 1e-3)
    harmonics_share: float = 0.4
    covered_alpha: float = 0.5


CONSTANTS = TrainerConstants()


@dataclass(frozen=True, eq=False)
class BatchGradients:
    """Sums over the views of a step, from all processes.

    Args:
        loss: (1,).
        grads: of the Gaussians' parameters by name.
        poses: (B, 4, 4) of each view's T_camera_world, float64; None if poses are not refined.
        intrinsics: (B, 4) of the changes of each view's camera, float64; None if intrinsics are not refined.
        exposures: (B, 3, 4) of each view's transform, float64; None if exposures are not compensated.
        seen: (B, N) uint8, 1 where a Gaussian is in view.
        centers: (B, N, 2) of the projected centres in an image of width and height 2; B is 0 if no strategy needs them.
    """

    loss: Tensor
    grads: dict[str, Tensor]
    poses: Tensor | None
    intrinsics: Tensor | None
    exposures: Tensor | None
    seen: Tensor
    centers: Tensor

    def meta(self) -> dict[str, Any]:
        """Return the values of a strategy as those of one packed render of all views."""
        views, ids = self.seen[: len(self.centers)].nonzero(as_tuple=True)
        rows = self.centers[views, ids]
        centers = SimpleNamespace(grad=rows, absgrad=rows)
        names = dict.fromkeys(("means2d", "gradient_2dgs"), centers)
        return {**names, "gaussian_ids": ids, "width": 2, "height": 2, "n_cameras": 1}


class Trainer:
    """The state of a training run. The same steps give the same bits, also across :meth:`state` and :meth:`restore`.

    Args:
        model: the Gaussians of the start; not changed.
        images: the training views.
        options: of the run.
        extent: of the scene [m], see :attr:`TrainingData.scene_extent`.
        group: the processes that train together; each has a trainer of the same state.
    """

    def __init__(
        self,
        model: GaussianModel,
        images: ImageCache,
        options: TrainingOptions,
        extent: float,
        group: TrainingGroup = ALONE,
    ) -> None:
        bands = (options.sh_degree + 1) ** 2
        start = as_surfels(model) if options.surfels else model
        self.model = replace(start.clone(), sh=start.sh[:, :bands].clone())
        self.images = images
        self.options = options
        self.extent = extent
        self.group = group
        self.iteration = 0
        self.poses = CameraPoses([view.T_world_camera for view in images.views], extent)
        self.intrinsics = CameraIntrinsics(images.views) if options.refine_intrinsics else None
        self.exposures = ExposureTransforms(len(images.views)) if options.exposure else None
        self.adam = GaussianAdam(dict.fromkeys(PARAMETERS, 0.0))
        self.adam.extend(self.model)
        self.strategy = options.make_strategy()
        self._growth = self.strategy.initialize_state(self.model, extent)
        self._random = torch.Generator().manual_seed(options.seed)
        self._order = torch.zeros(0, dtype=torch.int64)

    def state(self) -> dict[str, Any]:
        """Return all that the next steps depend on: tensors and numbers by name."""
        steps, first, second = self.adam.state()
        return {
            "iteration": self.iteration,
            "model": dict(vars(self.model)),
            "adam": {"steps": steps, "first": first, "second": second, "skipped": self.adam.skipped},
            "strategy": dict(self._growth),
            **{name: {field: getattr(part, field) for field in _OF_VIEWS[name]} for name, part in self._of_views()},
            "random": self._random.get_state(),
            "order": self._order,
        }

    def restore(self, state: dict[str, Any]) -> None:
        """Go back to a :meth:`state`."""
        self.iteration = state["iteration"]
        self.model = GaussianModel(**state["model"])
        adam = state["adam"]
        self.adam.restore((adam["steps"], adam["first"], adam["second"]))
        self.adam.skipped = adam["skipped"]
        self._growth = dict(state["strategy"])
        for name, part in self._of_views():
            for field in _OF_VIEWS[name]:
                setattr(part, field, state[name][field])
        self._random.set_state(state["random"])
        self._order = state["order"]

    def _of_views(self) -> list[tuple[str, Any]]:
        """Return name and estimator of each kind of values of views that this training has."""
        parts = [(name, getattr(self, name)) for name in _OF_VIEWS]
        return [(name, part) for name, part in parts if part is not None]

    def step(self, progress: float) -> float:
        """Run one iteration and return its mean loss.

        Args:
            progress: share of the run that is done, 0 to 1: rates, resolution and degree follow it.
        """
        with one_torch_thread():
            loss = self._step(progress)
        self.iteration += 1
        return loss

    def _step(self, progress: float) -> float:
        self.group.check_count(len(self.model))
        views = [(self._next_view(), self._background()) for _ in range(self.options.batch)]
        reduce = _reduction(progress, self.options.coarse_share)
        scheduled = int(progress / CONSTANTS.harmonics_share * (self.options.sh_degree + 1))
        degree = max(self.model.sh_degree, min(self.options.sh_degree, scheduled))
        self.model = grow_harmonics(self.model, self.adam, degree)
        self._set_rates(progress)
        weights = SurfaceWeights.at(self.options, progress, self.extent)
        batch = self._gradients(views, reduce, degree, weights)
        indices = [index for index, _ in views]
        if batch.poses is not None:
            for index, gradient in zip(indices, batch.poses, strict=True):
                self.poses.step(index, gradient, _between(CONSTANTS.pose_rate, progress))
        if self.intrinsics is not None and batch.intrinsics is not None:
            self.intrinsics.step(indices, batch.intrinsics, _between(CONSTANTS.intrinsics_rate, progress))
        if self.exposures is not None and batch.exposures is not None:
            self.exposures.step(indices, batch.exposures, _between(CONSTANTS.exposure_rate, progress))
        self._add_regularizers(batch.grads)
        seen = batch.seen.bool()
        with self._surfaces_kept(indices, reduce, seen):
            self.adam.step(self.model, batch.grads, seen.any(0))
        done = StrategyStep(self.iteration, progress, batch.meta(), self.adam, self._random)
        self.model = self.strategy.step_post_backward(self.model, self._growth, done)
        if self.options.surfels:
            flatten(self.model)
        return float(batch.loss)

    def _gradients(
        self, views: list[tuple[int, Tensor]], reduce: int, degree: int, weights: SurfaceWeights
    ) -> BatchGradients:
        """Compute the gradients of the mean loss over views and their backgrounds, each process those of its share."""
        n, count = len(self.model), len(views)
        parameters = {name: getattr(self.model, name).requires_grad_(True) for name in PARAMETERS}
        indices = [index for index, _ in views]
        viewmats = self.poses.viewmats[indices].requires_grad_(self.options.refine_poses)
        changes = None if self.intrinsics is None else self.intrinsics.of_views(indices).requires_grad_()
        transforms = None if self.exposures is None else self.exposures.transforms[indices].requires_grad_()
        loss, seen = torch.zeros(1), torch.zeros(count, n, dtype=torch.uint8)
        centers = torch.zeros(count if self._growth else 0, n, 2)
        for row in self.group.share(count):
            index, background = views[row]
            photo = self.images.photo(index, reduce)
            render = render_photo(
                self.model,
                photo,
                viewmats[row],
                background,
                degree,
                K=None if changes is None else matrix(self.images.views[index].camera, changes[row], photo.camera),
                depth=weights.normal > 0,
                surfels=self.options.surfels,
                antialiased=self.options.antialiased,
                absgrad=self.strategy.absgrad,
                distortion=weights.distortion > 0,
            )
            transform = None if transforms is None else transforms[row]
            own = self._loss(render, photo, background, transform)
            if self.options.surfels:
                own = own + surface_loss(render, weights, photo.trained)
            if changes is not None:
                own = own + prior(changes[row]).float()
            self.strategy.step_pre_backward(self._growth, render.meta)
            own.backward()
            loss += own.detach()
            seen[row] = render.meta["visibility"][0]
            if self._growth:
                half = torch.tensor([photo.camera.width, photo.camera.height]) / 2
                centers[row] = render.center_gradients(absolute=self.strategy.absgrad) * half
        grads = {name: parameter.grad.contiguous() for name, parameter in parameters.items()}
        for parameter in parameters.values():
            parameter.requires_grad_(False)
            parameter.grad = None
        poses, intrinsics, exposures = (of.grad if of is not None else None for of in (viewmats, changes, transforms))
        of_views = [grad for grad in (poses, intrinsics, exposures) if grad is not None]
        self.group.sum(loss, *grads.values(), seen, centers, *of_views)
        for total in (loss, *grads.values()):
            total /= count
        return BatchGradients(loss, grads, poses, intrinsics, exposures, seen, centers)

    @contextmanager
    def _surfaces_kept(self, views: list[int], reduce: int, seen: Tensor) -> Iterator[None]:
        """Return a context that limits the step in its block as mapping does, if surfaces are to be kept.

        Args:
            views: indices of the B views of the step.
            reduce: factor of their size.
            seen: (B, N) bool.
        """
        if not self.options.keep_surfaces:
            yield
            return
        rows = seen.any(0).nonzero()[:, 0]
        means, normals = self.model.means.index_select(0, rows), shortest_axes(self.model, rows)
        yield
        limit_normal_motion(self.model, rows, means, normals, _MAPPING.normal_step_scale)
        limits = {"max_pixels": _MAPPING.max_pixels, "thickness": _MAPPING.thickness}
        for index, of_view in zip(views, seen, strict=True):
            viewmat, focal = self.poses.viewmats[index], self.images.camera(index, reduce).fx
            limit_shape(self.model, of_view.nonzero()[:, 0], viewmat, focal, **limits)

    def _next_view(self) -> int:
        """Return the next view of a random order, in which each view comes once."""
        if not len(self._order):
            self._order = torch.randperm(len(self.images.views), generator=self._random)
        index, self._order = int(self._order[0]), self._order[1:].clone()
        return index

    def _set_rates(self, progress: float) -> None:
        c = CONSTANTS
        rest = [c.dc_rate * c.rest_share] * 3 * (self.model.sh.shape[1] - 1)
        self.adam.rates = {
            "means": _between(c.means_rate, progress) * self.extent,
            "quats": c.quats_rate,
            "log_scales": [c.scales_rate, c.scales_rate, 0.0] if self.options.surfels else c.scales_rate,
            "opacity_logits": c.opacities_rate,
            "sh": [c.dc_rate] * 3 + rest,
        }

    def _background(self) -> Tensor:
        if self.options.background == "random":
            return torch.rand(3, generator=self._random)
        return self.options.shade

    def _loss(self, render: MapRender, photo: Photo, background: Tensor, transform: Tensor | None) -> Tensor:
        """Compute L = (1 - λ) L1 + λ (1 - SSIM) + w_d mean |(D - D*) / D*|, over the pixels that are trained on.

        With a transform (3, 4), the colours are those of the photograph's exposure.
        """
        colors = render.image[..., :3]
        if transform is not None:
            colors = exposed(colors, render.alpha, background, transform)
        loss = l1_dssim(colors.contiguous(), photo.over(background), self.options.dssim_weight, photo.trained)
        if photo.depth is None or self.options.depth_weight == 0:
            return loss
        depth = photo.depth[..., None]
        measured = (depth > 0) & (render.alpha.detach() > CONSTANTS.covered_alpha)
        if photo.trained is not None:
            measured &= photo.trained[..., None]
        return loss + self.options.depth_weight * relative_depth_error(render.image[..., 3:], depth, measured)

    def _add_regularizers(self, grads: dict[str, Tensor]) -> None:
        """Add the gradients of w_o · mean o + w_s · mean σ."""
        opacity, scale = self.options.regularizers
        n = max(1, len(self.model))
        if opacity > 0:
            o = self.model.opacities
            grads["opacity_logits"] += opacity / n * o * (1 - o)
        if scale > 0:
            grads["log_scales"] += scale / (3 * n) * self.model.scales


def _reduction(progress: float, coarse_share: float) -> int:
    """Return the factor of the resolution: a quarter for the first third of ``coarse_share``, then a half, then all."""
    if progress >= coarse_share:
        return 1
    return 4 if progress < coarse_share / 3 else 2


def _between(ends: tuple[float, float], progress: float) -> float:
    """Interpolate exponentially."""
    return float(ends[0] * (ends[1] / ends[0]) ** min(1.0, max(0.0, progress)))

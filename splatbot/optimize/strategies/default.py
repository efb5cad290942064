"""Adaptive density control of 3D Gaussian splatting."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from splatbot.gaussians import GaussianModel
from splatbot.optimize.strategies.base import Strategy, StrategyStep
from splatbot.optimize.strategies.edits import duplicate, remove, reset_opacities, split


@dataclass(frozen=True)
class DefaultStrategy(Strategy):
    """Clones and splits Gaussians whose projected centres have large gradients (Kerbl et al. 2023, Sec. 5.2).

    Field names and defaults are gsplat's, but the stop is a share of the run, so that a budget of time can end it.

    Args:
        prune_opa: Gaussians of a lower opacity are removed.
        grow_grad2d: mean gradient norm of the centre, in an image of width 2, above which a Gaussian is too coarse.
        grow_scale3d: such Gaussians are cloned up to this size [share of the scene's extent], and split above it.
        prune_scale3d: larger ones are removed after the first reset [share of the scene's extent].
        refine_start_iter: first iteration of changes.
        refine_stop: share of the run after which nothing changes.
        reset_every: iterations between two resets of the opacities to twice ``prune_opa``.
        refine_every: iterations between two changes.
        pause_refine_after_reset: iterations without changes after a reset.
        key_for_gradient: name of the projected centres in meta: "gradient_2dgs" for surfels.
        absgrad: sum absolute gradients over pixels (Ye et al. 2024); ``grow_grad2d`` is then some 0.0008.
        revised_opacity: opacities of halves by Bulò et al. 2024.
        cap_max: largest number of Gaussians; the largest gradients have priority near it.
    """

    prune_opa: float = 0.005
    grow_grad2d: float = 0.0002
    grow_scale3d: float = 0.01
    prune_scale3d: float = 0.1
    refine_start_iter: int = 500
    refine_stop: float = 0.5
    reset_every: int = 3000
    refine_every: int = 100
    pause_refine_after_reset: int = 0
    key_for_gradient: str = "means2d"
    absgrad: bool = False
    revised_opacity: bool = False
    cap_max: int = 1_000_000

    def initialize_state(self, model: GaussianModel, scene_scale: float) -> dict[str, Any]:
        """Return sums of zero: ``grad2d`` (N,), ``count`` (N,), and ``scene_scale`` [m]."""
        n = len(model)
        return {"grad2d": torch.zeros(n), "count": torch.zeros(n), "scene_scale": scene_scale}

    def step_pre_backward(self, state: dict[str, Any], meta: Mapping[str, Any]) -> None:
        """Keep the gradient of the projected centres."""
        meta[self.key_for_gradient].retain_grad()

    @torch.no_grad()
    def step_post_backward(self, model: GaussianModel, state: dict[str, Any], step: StrategyStep) -> GaussianModel:
        """Return the model after clones, splits, removals and resets; see :class:`Strategy`."""
        if step.progress >= self.refine_stop:
            return model
        self._count(state, step.meta)
        paused = step.number % self.reset_every < self.pause_refine_after_reset
        if step.number > self.refine_start_iter and step.number % self.refine_every == 0 and not paused:
            model = self._grow(model, state, step)
            model = self._prune(model, state, step)
            state |= self.initialize_state(model, state["scene_scale"])
        if step.number > 0 and step.number % self.reset_every == 0:
            model = reset_opacities(model, step.adam, 2 * self.prune_opa)
        return model

    def _count(self, state: dict[str, Any], meta: Mapping[str, Any]) -> None:
        """Add the norms of the centres' gradients in an image of width and height 2."""
        centers = meta[self.key_for_gradient]
        gradient = centers.absgrad if self.absgrad else centers.grad
        half = torch.tensor([meta["width"], meta["height"]]) / 2 * meta["n_cameras"]
        ids = meta["gaussian_ids"]
        state["grad2d"].index_add_(0, ids, (gradient * half).norm(dim=-1).nan_to_num(0.0, 0.0, 0.0))
        state["count"].index_add_(0, ids, torch.ones(len(ids)))

    def _grow(self, model: GaussianModel, state: dict[str, Any], step: StrategyStep) -> GaussianModel:
        gradient = state["grad2d"] / state["count"].clamp_min(1)
        coarse = _largest(gradient, self.grow_grad2d, self.cap_max - len(model))
        small = model.scales.amax(1) <= self.grow_scale3d * state["scene_scale"]
        cloned, halved = coarse & small, coarse & ~small
        model = duplicate(model, step.adam, cloned)
        halved = torch.cat([halved, torch.zeros(int(cloned.sum()), dtype=torch.bool)])
        return split(model, step.adam, halved, random=step.random, revised_opacity=self.revised_opacity)

    def _prune(self, model: GaussianModel, state: dict[str, Any], step: StrategyStep) -> GaussianModel:
        useless = model.opacities < self.prune_opa
        if step.number > self.reset_every:
            useless |= model.scales.amax(1) > self.prune_scale3d * state["scene_scale"]
        return remove(model, step.adam, useless)


def _largest(values: Tensor, limit: float, most: int) -> Tensor:
    """Return a mask of the values above ``limit``: all of them, or the ``most`` largest."""
    above = values > limit
    if int(above.sum()) <= most:
        return above
    chosen = torch.zeros_like(above)
    chosen[values.topk(max(0, most)).indices] = True
    return chosen & above

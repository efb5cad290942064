"""Refinement: a few steps of gradient descent on the map, over the latest keyframes and some old ones."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import takewhile
from typing import Any

import numpy as np
import torch
from torch import Tensor

from splatbot.config import MappingConfig
from splatbot.gaussians import GaussianModel
from splatbot.gaussians.harmonics import sh_to_rgb
from splatbot.gaussians.shape import shortest_axes
from splatbot.mapping.densify import PositionGradients
from splatbot.mapping.keyframes import Keyframe
from splatbot.optimize.adam import PARAMETERS, GaussianAdam
from splatbot.optimize.losses import l1, l1_dssim
from splatbot.rasterize import rasterization

Stop = Callable[[], bool]
"""Asked before each step whether there are to be no more."""

_GONE = 0.1  # where a keyframe is nearer than the map by more, it shows something that has gone [share of depth]


def never() -> bool:
    """Nothing ends it early."""
    return False


class Refiner:
    """Owns the optimiser; the mapper tells it when rows come and go."""

    def __init__(self, config: MappingConfig, seed: int) -> None:
        self.config = config
        self.adam = GaussianAdam(
            {
                "means": config.means_lr,
                "quats": config.quats_lr,
                "log_scales": config.scales_lr,
                "opacity_logits": config.opacities_lr,
                "sh": config.sh_lr,
            }
        )
        self._random = np.random.default_rng(seed)
        self._latest = -1  # number of the latest keyframe that a step was spent on as such

    def state(self) -> Any:
        """All that steps change besides the model, for :meth:`restore`."""
        return self.adam.state(), self._random.bit_generator.state, self._latest

    def restore(self, state: Any) -> None:
        """Go back to a :meth:`state`."""
        adam, self._random.bit_generator.state, self._latest = state
        self.adam.restore(adam)

    def refine(self, model: GaussianModel, keyframes: Sequence[Keyframe], iterations: int, stop: Stop = never) -> None:
        """Spend ``iterations`` steps on the model, in place: on the latest keyframe if it has had none, then at random.

        Half of the random draws come from the latest ``config.window`` keyframes, half from all, against forgetting.
        """
        for _ in takewhile(lambda _: not stop(), range(iterations if len(model) else 0)):
            fresh = keyframes[-1].number > self._latest
            self._latest = keyframes[-1].number
            self.step(model, keyframes[-1] if fresh else self._draw(keyframes))

    def refine_all(
        self,
        model: GaussianModel,
        keyframes: Sequence[Keyframe],
        iterations: int,
        position_gradients: PositionGradients | None = None,
        stop: Stop = never,
    ) -> None:
        """Spend ``iterations`` steps on all keyframes alike; ``position_gradients`` gathers how hard they position_gradients at the centres."""
        for _ in takewhile(lambda _: not stop(), range(iterations if len(model) else 0)):
            self.step(model, keyframes[int(self._random.integers(len(keyframes)))], position_gradients)

    def _draw(self, keyframes: Sequence[Keyframe]) -> Keyframe:
        pool = keyframes[-self.config.window :] if self._random.random() < 0.5 else keyframes
        return pool[int(self._random.integers(len(pool)))]

    def step(self, model: GaussianModel, keyframe: Keyframe, position_gradients: PositionGradients | None = None) -> float:
        """One step on one keyframe; returns the loss before it.

        Torch's threads spin after each operation and so starve the rasterizer's; one is several times faster here.
        """
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        try:
            return self._step(model, keyframe, position_gradients)
        finally:
            torch.set_num_threads(threads)

    def _step(self, model: GaussianModel, keyframe: Keyframe, position_gradients: PositionGradients | None) -> float:
        parameters = {name: getattr(model, name).detach().requires_grad_(True) for name in PARAMETERS}
        renders, alphas, meta = rasterization(
            parameters["means"],
            parameters["quats"],
            parameters["log_scales"].exp(),
            torch.sigmoid(parameters["opacity_logits"]),
            sh_to_rgb(parameters["sh"][:, 0]),
            keyframe.viewmat,
            keyframe.K,
            keyframe.camera.width,
            keyframe.camera.height,
            render_mode="RGB+ED",
            depth_mode="plane",  # what tracking is aligned to
        )
        rows = meta["visible_ids"][0]
        centers = [] if position_gradients is None else [meta["means2d"]]
        loss = self._loss(renders[0], alphas[0], keyframe)
        grads = torch.autograd.grad(loss, [*parameters.values(), *centers])
        if position_gradients is not None:
            position_gradients.add(rows, grads[-1], keyframe.camera.width)
        visible = torch.zeros(len(model), dtype=torch.bool)
        visible[rows] = True
        means, normals = model.means.index_select(0, rows), shortest_axes(model, rows)
        self.adam.step(model, dict(zip(PARAMETERS, grads[: len(PARAMETERS)], strict=True)), visible)
        self._keep_on_surface(model, rows, means, normals)
        self._keep_flat(model, keyframe, rows)
        return float(loss.detach())

    def _keep_on_surface(self, model: GaussianModel, rows: Tensor, means: Tensor, normals: Tensor) -> None:
        """Take back most of what a step has moved means along their normals.

        The depth of all looks has been fused there, by its noise. A step sees one picture, and colour says next to
        nothing of how far a plain wall is; where along the surface a Gaussian belongs, it does say.

        Args:
            means, normals: (M, 3) [m] of ``rows`` before the step.
        """
        after = model.means.index_select(0, rows)
        along = ((after - means) * normals).sum(1, keepdim=True)
        model.means.index_copy_(0, rows, after.addcmul_(along, normals, value=self.config.normal_step_scale - 1))

    def _keep_flat(self, model: GaussianModel, keyframe: Keyframe, rows: Tensor) -> None:
        """Gaussians in view stay discs: thin, and no larger than ``config.max_pixels`` of this keyframe.

        Pictures do not ask for it: a needle before a plain wall changes no pixel, and a blob shows what its disc does.
        But both reach into free space, and the normal of a blob is any.
        """
        viewmat = keyframe.viewmat[0].to(torch.float32)
        z = model.means[rows] @ viewmat[2, :3] + viewmat[2, 3]
        limit = (self.config.max_pixels * z / float(keyframe.K[0, 0, 0])).log()
        sizes, axes = torch.minimum(model.log_scales[rows], limit[:, None]).sort(1)
        sizes[:, 0] = torch.minimum(sizes[:, 0], sizes[:, 1] + math.log(self.config.thickness))
        model.log_scales[rows] = torch.empty_like(sizes).scatter_(1, axes, sizes)

    def _loss(self, render: Tensor, alpha: Tensor, keyframe: Keyframe) -> Tensor:
        observed = keyframe.rgb.float() / 255.0
        covered = alpha[..., 0].detach() > 0.5
        if keyframe.static_mask is not None:
            covered &= keyframe.static_mask
        # What was before the map's surface and is there no more has nothing to say of what is behind.
        covered &= ~((keyframe.depth > 0) & (render[..., 3].detach() * (1 - _GONE) > keyframe.depth))
        color = self._color_loss(render[..., :3], observed, covered)
        depth = keyframe.depth[..., None]
        ranged = (depth > 0) & covered[..., None]
        relative = l1(render[..., 3:] / depth.clamp_min(0.1), depth / depth.clamp_min(0.1), ranged)
        return color + self.config.depth_weight * relative

    def _color_loss(self, rendered: Tensor, observed: Tensor, covered: Tensor) -> Tensor:
        if self.config.dssim_weight > 0:
            return l1_dssim(rendered, observed, self.config.dssim_weight, covered)
        return l1(rendered, observed, covered[..., None])

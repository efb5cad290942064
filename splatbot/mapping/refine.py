"""Refinement: gradient descent on the map, over the latest keyframes and some older ones."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
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
from splatbot.optimize.losses import l1, l1_dssim, relative_depth_error
from splatbot.optimize.surfaces import limit_normal_motion, limit_shape
from splatbot.rasterize import rasterization
from splatbot.rasterize.native import one_torch_thread

Stop = Callable[[], bool]
"""Called before each iteration; refinement ends once it returns True."""


@dataclass(frozen=True)
class RefineConstants:
    """Constants of refinement.

    Args:
        removed_depth_share: [share of depth] where a keyframe's depth is smaller than the map's by more, it shows an
            object that was removed since. Such pixels carry no loss.
        covered_alpha: pixels that the map covers less carry no loss.
        latest_share: share of the random draws that come from the latest ``window`` keyframes.
    """

    removed_depth_share: float = 0.1
    covered_alpha: float = 0.5
    latest_share: float = 0.5


CONSTANTS = RefineConstants()


def never() -> bool:
    """Return False: the default of :data:`Stop`."""
    return False


class Refiner:
    """Minimizes the photometric and depth loss of the map with Adam; owns the optimizer and the random draws.

    Learning rates are those of ``config``: ``means_lr`` [m], ``quats_lr``, ``scales_lr`` (log-scales),
    ``opacities_lr`` (logits) and ``sh_lr``. They stay constant, in contrast to the decay of Kerbl et al. 2023,
    because new Gaussians keep arriving.
    """

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
        self._latest_refined = -1
        """Number of the latest keyframe that has had its first iteration."""

    def state(self) -> Any:
        """Return the state of the optimizer and the random draws, for :meth:`restore`."""
        return self.adam.state(), self._random.bit_generator.state, self._latest_refined

    def restore(self, state: Any) -> None:
        """Go back to an earlier :meth:`state`."""
        adam, self._random.bit_generator.state, self._latest_refined = state
        self.adam.restore(adam)

    def refine(self, model: GaussianModel, keyframes: Sequence[Keyframe], iterations: int, stop: Stop = never) -> None:
        """Run iterations on the model, in place: the first on a new keyframe, then on random ones.

        Half of the random draws come from the latest ``config.window`` keyframes, half from all of them, because the
        map would forget older views otherwise.
        """
        for _ in takewhile(lambda _: not stop(), range(iterations if len(model) else 0)):
            is_new = keyframes[-1].number != self._latest_refined
            self._latest_refined = keyframes[-1].number
            self.step(model, keyframes[-1] if is_new else self._draw(keyframes))

    def refine_all(
        self,
        model: GaussianModel,
        keyframes: Sequence[Keyframe],
        iterations: int,
        position_gradients: PositionGradients | None = None,
        stop: Stop = never,
    ) -> None:
        """Run iterations on uniformly drawn keyframes, in place.

        Args:
            position_gradients: If given, it accumulates the gradients of the projected centers.
        """
        for _ in takewhile(lambda _: not stop(), range(iterations if len(model) else 0)):
            self.step(model, keyframes[int(self._random.integers(len(keyframes)))], position_gradients)

    def step(
        self, model: GaussianModel, keyframe: Keyframe, position_gradients: PositionGradients | None = None
    ) -> float:
        """Run one iteration on one keyframe; return the loss before it. An error leaves map and optimizer unchanged."""
        with one_torch_thread():
            return self._step(model, keyframe, position_gradients)

    def _draw(self, keyframes: Sequence[Keyframe]) -> Keyframe:
        latest = self._random.random() < CONSTANTS.latest_share
        pool = keyframes[-self.config.window :] if latest else keyframes
        return pool[int(self._random.integers(len(pool)))]

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
            depth_mode="plane",  # the depth that tracking aligns to
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
        with self._rows_restored_on_error(model, rows):
            self.adam.step(model, dict(zip(PARAMETERS, grads[: len(PARAMETERS)], strict=True)), visible)
            limit_normal_motion(model, rows, means, normals, self.config.normal_step_scale)
            limit_shape(
                model,
                rows,
                keyframe.viewmat[0],
                float(keyframe.K[0, 0, 0]),
                max_pixels=self.config.max_pixels,
                thickness=self.config.thickness,
            )
        return float(loss.detach())

    @contextmanager
    def _rows_restored_on_error(self, model: GaussianModel, rows: Tensor) -> Iterator[None]:
        """Return a context that undoes writes to these rows of parameters and moments if its block raises."""
        parameters = [getattr(model, name) for name in PARAMETERS]
        tensors = [*parameters, *self.adam.first.values(), *self.adam.second.values(), self.adam.steps]
        before = [tensor.index_select(0, rows) for tensor in tensors]
        try:
            yield
        except BaseException:
            for tensor, values in zip(tensors, before, strict=True):
                tensor.index_copy_(0, rows, values)
            raise

    def _loss(self, render: Tensor, alpha: Tensor, keyframe: Keyframe) -> Tensor:
        """Compute the loss L = L_color + w_d · mean |(D - D*) / D*| over covered, static pixels.

        L_color is the mean |C - C*|, or with ``dssim_weight`` λ the loss (1 - λ) L1 + λ (1 - SSIM) of Kerbl et al.
        2023, Eq. 7. D is the rendered and D* the measured depth; w_d is ``depth_weight``.
        """
        observed = keyframe.rgb.float() / 255.0
        covered = alpha[..., 0].detach() > CONSTANTS.covered_alpha
        if keyframe.static_mask is not None:
            covered &= keyframe.static_mask
        # An object that was removed since hides the surface behind it, so its pixels carry no information on the map.
        seen_behind = render[..., 3].detach() * (1 - CONSTANTS.removed_depth_share) > keyframe.depth
        covered &= ~((keyframe.depth > 0) & seen_behind)
        color = self._color_loss(render[..., :3], observed, covered)
        depth = keyframe.depth[..., None]
        measured = (depth > 0) & covered[..., None]
        return color + self.config.depth_weight * relative_depth_error(render[..., 3:], depth, measured)

    def _color_loss(self, rendered: Tensor, observed: Tensor, covered: Tensor) -> Tensor:
        if self.config.dssim_weight > 0:
            return l1_dssim(rendered, observed, self.config.dssim_weight, covered)
        return l1(rendered, observed, covered[..., None])

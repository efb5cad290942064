"""The interface of a strategy."""

from __future__ import annotations

from typing import Any, Protocol

import torch

from splatbot.gaussians import GaussianModel
from splatbot.optimize.adam import GaussianAdam
from splatbot.rasterize.meta import RenderMeta


class Strategy(Protocol):
    """Changes the number of Gaussians between two steps of the optimizer.

    A strategy keeps no values of its own: they are in the state, which a checkpoint saves. Random draws come from
    ``random`` alone, so that a resumed run repeats them.
    """

    @property
    def absgrad(self) -> bool:
        """Return whether :meth:`step_post_backward` needs the absolute gradients of the projected centres."""
        ...

    def initialize_state(self, model: GaussianModel, scene_scale: float) -> dict[str, Any]:
        """Return the state before the first step: tensors and numbers by name."""
        ...

    def step_pre_backward(self, state: dict[str, Any], meta: RenderMeta) -> None:
        """Prepare the render of a step for :meth:`step_post_backward`, before the backward pass."""
        ...

    def step_post_backward(
        self,
        model: GaussianModel,
        adam: GaussianAdam,
        state: dict[str, Any],
        step: int,
        meta: RenderMeta,
        *,
        progress: float,
        random: torch.Generator,
    ) -> GaussianModel:
        """Return the model after the changes of this step; the moments of ``adam`` follow it.

        Args:
            model: after the optimizer's step.
            adam: the optimizer; its rate of the means scales the noise of MCMC.
            state: of :meth:`initialize_state`, updated in place.
            step: number of the iteration, from 0.
            meta: of the render of this step; after the backward pass.
            progress: share of the run that is done, 0 to 1.
            random: generator of the random draws.
        """
        ...

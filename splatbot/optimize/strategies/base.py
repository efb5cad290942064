"""The interface of a strategy, and the strategy that changes nothing."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch

from splatbot.gaussians import GaussianModel
from splatbot.optimize.adam import GaussianAdam


@dataclass(frozen=True)
class StrategyStep:
    """An iteration after its backward pass and the optimizer's step.

    Args:
        number: of the iteration, from 0.
        progress: share of the run that is done, 0 to 1.
        meta: of the render, or of all renders of the step, see :class:`splatbot.rasterize.meta.RenderMeta`.
        adam: the optimizer; its moments follow the Gaussians, and its rate of the means scales the noise of MCMC.
        random: generator of the random draws.
    """

    number: int
    progress: float
    meta: Mapping[str, Any]
    adam: GaussianAdam
    random: torch.Generator


class Strategy:
    """Changes the number of Gaussians between two steps of the optimizer; this one keeps those of the start.

    A strategy holds settings only. Its values are in the state, which a checkpoint saves. Random draws come from the
    generator of the step alone, so that a resumed run repeats them.
    """

    absgrad: bool = False
    """True if :meth:`step_post_backward` needs the absolute gradients of the projected centres."""

    def initialize_state(self, model: GaussianModel, scene_scale: float) -> dict[str, Any]:
        """Return the state before the first step: tensors and numbers by name."""
        return {}

    def step_pre_backward(self, state: dict[str, Any], meta: Mapping[str, Any]) -> None:
        """Prepare the render of a step for :meth:`step_post_backward`, before the backward pass."""

    def step_post_backward(self, model: GaussianModel, state: dict[str, Any], step: StrategyStep) -> GaussianModel:
        """Return the model after the changes of a step.

        Args:
            model: after the optimizer's step.
            state: of :meth:`initialize_state`, updated in place.
            step: the iteration.
        """
        return model

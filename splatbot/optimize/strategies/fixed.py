"""No densification."""

from __future__ import annotations

from typing import Any

import torch

from splatbot.gaussians import GaussianModel
from splatbot.optimize.adam import GaussianAdam
from splatbot.rasterize.meta import RenderMeta


class FixedStrategy:
    """Keeps the Gaussians of the start: for maps whose surface depth measurements already cover."""

    absgrad = False

    def initialize_state(self, model: GaussianModel, scene_scale: float) -> dict[str, Any]:
        """Return an empty state."""
        return {}

    def step_pre_backward(self, state: dict[str, Any], meta: RenderMeta) -> None:
        """Keep nothing of the render."""

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
        """Return the model as it is."""
        return model

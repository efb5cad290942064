"""3D Gaussian splatting as Markov chain Monte Carlo."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch

from splatbot.gaussians import GaussianModel
from splatbot.optimize.strategies.base import Strategy, StrategyStep
from splatbot.optimize.strategies.edits import inject_noise, relocate, sample_add


@dataclass(frozen=True)
class MCMCStrategy(Strategy):
    """Moves faint Gaussians to where opaque ones are, and grows up to a cap (Kheradmand et al. 2024).

    Field names and defaults are gsplat's, but the stop is a share of the run, so that a budget of time can end it. The
    loss needs small weights on opacities and scales, which make needless Gaussians faint.

    Args:
        cap_max: largest number of Gaussians.
        noise_lr: factor of the noise, times the learning rate of the means.
        refine_start_iter: first iteration of relocations.
        refine_stop: share of the run after which none follow.
        refine_every: iterations between two of them.
        min_opacity: Gaussians of no more opacity are relocated.
    """

    cap_max: int = 1_000_000
    noise_lr: float = 5e5
    refine_start_iter: int = 500
    refine_stop: float = 0.8
    refine_every: int = 100
    min_opacity: float = 0.005

    @torch.no_grad()
    def step_post_backward(self, model: GaussianModel, state: dict[str, Any], step: StrategyStep) -> GaussianModel:
        """Return the model after relocations, growth by 5 %, and noise; see :class:`Strategy`."""
        adam, random = step.adam, step.random
        changes = step.number > self.refine_start_iter and step.number % self.refine_every == 0
        if changes and step.progress < self.refine_stop:
            dead = model.opacities <= self.min_opacity
            model = relocate(model, adam, dead, least_opacity=self.min_opacity, random=random)
            new = max(0, min(self.cap_max, int(1.05 * len(model))) - len(model))
            model = sample_add(model, adam, new, least_opacity=self.min_opacity, random=random)
        rate = adam.rates["means"]
        assert isinstance(rate, float)
        inject_noise(model, rate * self.noise_lr, random=random)
        return model

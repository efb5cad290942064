"""Optimizers and iterations for tests of strategies."""

from __future__ import annotations

from typing import Any

import torch

from splatbot.gaussians import GaussianModel
from splatbot.optimize.adam import PARAMETERS, GaussianAdam
from splatbot.optimize.strategies import StrategyStep


def adam_of(model: GaussianModel) -> GaussianAdam:
    """Return an optimizer of the model before its first step."""
    adam = GaussianAdam(dict.fromkeys(PARAMETERS, 1e-3))
    adam.extend(model)
    return adam


def step_of(number: int, adam: GaussianAdam, meta: Any = None, *, progress: float = 0.1, seed: int = 0) -> StrategyStep:
    """Return an iteration with a generator of its own."""
    return StrategyStep(number, progress, meta, adam, torch.Generator().manual_seed(seed))

"""Strategies of densification: when Gaussians are cloned, split, relocated and removed; gsplat's names."""

from __future__ import annotations

from splatbot.optimize.strategies.base import Strategy, StrategyStep
from splatbot.optimize.strategies.default import DefaultStrategy
from splatbot.optimize.strategies.mcmc import MCMCStrategy

__all__ = ["DefaultStrategy", "MCMCStrategy", "Strategy", "StrategyStep"]

"""Adam over the arrays of a Gaussian model that grows and shrinks."""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor

from splatbot.gaussians import GaussianModel

PARAMETERS = ("means", "quats", "log_scales", "opacity_logits", "sh")


class GaussianAdam:
    """Adam (Kingma & Ba 2015) with one learning rate per kind of parameter; moments follow the Gaussians.

    Each Gaussian counts its own steps, so that the bias of a new one's moments is corrected as its own.
    """

    betas = (0.9, 0.99)
    eps = 1e-15

    def __init__(self, rates: Mapping[str, float]) -> None:
        self.rates = dict(rates)
        self.steps = torch.zeros(0)
        self.first: dict[str, Tensor] = {}
        self.second: dict[str, Tensor] = {}

    def extend(self, model: GaussianModel) -> None:
        """Rows were appended to ``model``: give them moments of zero."""
        n = len(model) - len(self.steps)
        self.steps = torch.cat([self.steps, torch.zeros(n)])
        for name in PARAMETERS:
            shape = getattr(model, name).shape[1:]
            for moments in (self.first, self.second):
                old = moments.get(name, torch.zeros(0, *shape))
                moments[name] = torch.cat([old, torch.zeros(n, *shape)])

    def select(self, index: Tensor) -> None:
        """Keep the rows that ``index`` names, as :meth:`GaussianModel.select` does."""
        self.steps = self.steps[index]
        for moments in (self.first, self.second):
            for name in PARAMETERS:
                moments[name] = moments[name][index]

    @torch.no_grad()
    def step(self, model: GaussianModel, grads: Mapping[str, Tensor], visible: Tensor) -> None:
        """One step in place, of the rows that ``visible`` (N,) marks."""
        rows = visible.nonzero()[:, 0]
        self.steps[rows] += 1
        b1, b2 = self.betas
        count = self.steps[rows]
        c1, c2 = 1 - b1**count, 1 - b2**count
        for name, grad in grads.items():
            g = grad[rows]
            m = self.first[name][rows].mul_(b1).add_(g, alpha=1 - b1)
            v = self.second[name][rows].mul_(b2).addcmul_(g, g, value=1 - b2)
            self.first[name][rows] = m
            self.second[name][rows] = v
            shape = (-1,) + (1,) * (g.ndim - 1)
            update = m / c1.view(shape) / ((v / c2.view(shape)).sqrt_() + self.eps)
            getattr(model, name)[rows] -= self.rates[name] * update

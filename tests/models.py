"""Random maps for tests of code that takes any model."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.gaussians import GaussianModel


def random_model(n: int, rng: np.random.Generator, *, least: float = 0.01) -> GaussianModel:
    """Return Gaussians within a few metres, with scales from ``least`` to 0.1 m and opacities from 0.1 to 0.9."""
    return GaussianModel.from_activated(
        means=rng.normal(size=(n, 3)),
        quats=rng.normal(size=(n, 4)),
        scales=rng.uniform(least, 0.1, (n, 3)),
        opacities=rng.uniform(0.1, 0.9, n),
        colors=rng.uniform(0, 1, (n, 3)),
    )


def uniform_model(means: NDArray[np.float64], scale: float = 0.1) -> GaussianModel:
    """Return grey spheres of a scale [m] with opacity 0.9 at the given means (N, 3) [m]."""
    n = len(means)
    return GaussianModel.from_activated(
        means=means,
        quats=np.tile([1.0, 0, 0, 0], (n, 1)),
        scales=np.full((n, 3), scale),
        opacities=np.full(n, 0.9),
        colors=np.full((n, 3), 0.5),
    )

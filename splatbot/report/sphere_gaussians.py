"""Spheres drawn as Gaussians, to show robots and contacts in a map."""

from __future__ import annotations

import numpy as np

from splatbot.gaussians import GaussianModel
from splatbot.protocols import Array


def sphere_gaussians(centers: Array, radii: Array, color: Array, opacity: float) -> GaussianModel:
    """Create Gaussians that look like spheres: ``centers`` (N, 3), ``radii`` (N,) [m], ``color`` (3,) in 0..1."""
    n = len(centers)
    return GaussianModel.from_activated(
        means=centers,
        quats=np.tile([1.0, 0.0, 0.0, 0.0], (n, 1)),
        scales=np.repeat(radii[:, None] / 2.2, 3, axis=1),
        opacities=np.full(n, opacity),
        colors=np.tile(color, (n, 1)),
    )

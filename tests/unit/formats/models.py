"""Maps for tests of formats, and comparisons of them."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.gaussians import GaussianModel

Array = NDArray[np.float64]

ROUNDING = 1e-6  # of float32, relative to values of about 1


def detailed_model(n: int = 700, degree: int = 0, seed: int = 0) -> GaussianModel:
    """Return Gaussians of all parameters within the range of every format: 3 m, scales of 7 mm to 14 cm."""
    rng = np.random.default_rng(seed)

    def tensor(values: Array) -> torch.Tensor:
        return torch.from_numpy(values.astype(np.float32))

    sh = 0.3 * rng.uniform(-1, 1, (n, (degree + 1) ** 2, 3))
    sh[:, 0] = rng.uniform(-1.7, 1.7, (n, 3))  # colours in 0.02..0.98
    return GaussianModel(
        means=tensor(rng.uniform(-1.5, 1.5, (n, 3))),
        quats=tensor(rng.normal(size=(n, 4))),
        log_scales=tensor(rng.uniform(-5, -2, (n, 3))),
        opacity_logits=tensor(rng.uniform(-4, 4, n)),
        sh=tensor(sh),
        observations=torch.arange(n, dtype=torch.int32) + 2,
        anchors=torch.arange(n, dtype=torch.int32),
    )


def unit(quats: torch.Tensor) -> Array:
    """Return unit quaternions (N, 4) in float64."""
    values = quats.numpy().astype(np.float64)
    return values / np.linalg.norm(values, axis=1, keepdims=True)


def quat_errors(a: GaussianModel, b: GaussianModel) -> Array:
    """Return the distances (N,) of the rotations' unit quaternions, whose sign has no meaning."""
    p, q = unit(a.quats), unit(b.quats)
    return np.minimum(np.linalg.norm(p - q, axis=1), np.linalg.norm(p + q, axis=1))


def errors(a: torch.Tensor, b: torch.Tensor) -> Array:
    """Return the absolute differences in float64."""
    return np.abs(a.numpy().astype(np.float64) - b.numpy().astype(np.float64))

"""Maps for tests of tiles."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.bench.sizing.measuring import building_discs
from splatbot.gaussians import GaussianModel

Array = NDArray[np.float64]

SIDE, HEIGHT = 12.0, 3.0  # [m] of the building
COLUMNS = ("means", "quats", "log_scales", "opacity_logits", "sh", "observations", "anchors", "uncertainty", "misses")


def building(n: int, *, seed: int = 0, side: float = SIDE, degree: int = 0, size: float = 0.02) -> GaussianModel:
    """Return discs of ``size`` [m] on the floors, ceilings and walls of rooms, of random bookkeeping.

    Args:
        n: number of Gaussians.
        seed: of all values.
        side: [m] of the square floor.
        degree: of the harmonics.
        size: median standard deviation of the two long axes [m].
    """
    rng = np.random.default_rng(seed)
    means, scales = building_discs(rng, n, side, size)
    model = GaussianModel.from_activated(
        means=means,
        quats=np.tile((2.0, 0.0, 0.0, 0.0), (n, 1)) + 0.05 * rng.normal(size=(n, 4)),
        scales=scales,
        opacities=rng.uniform(0.3, 0.95, n),
        colors=0.5 + 0.3 * np.sin(2.0 * means + means[:, ::-1]) + rng.uniform(-0.2, 0.2, (n, 3)),
    )
    rest = torch.from_numpy(0.05 * rng.normal(size=(n, (degree + 1) ** 2 - 1, 3))).float()
    return GaussianModel(
        model.means,
        model.quats,
        model.log_scales,
        model.opacity_logits,
        torch.cat([model.sh, rest], dim=1),
        observations=torch.from_numpy(rng.integers(0, 9, n).astype(np.int32)),
        anchors=torch.from_numpy(rng.integers(-1, 40, n).astype(np.int32)),
        uncertainty=torch.from_numpy(rng.uniform(0.0, 0.01, n).astype(np.float32)),
        misses=torch.from_numpy(rng.integers(0, 6, n).astype(np.int32)),
    )


def assert_equal(found: GaussianModel, expected: GaussianModel) -> None:
    """Assert that two models have the same bits."""
    for name in COLUMNS:
        a, b = getattr(found, name), getattr(expected, name)
        assert a.dtype == b.dtype, name
        assert torch.equal(a, b), name


def boxes_of(model: GaussianModel, n_sigma: float) -> tuple[Array, Array]:
    """Return the exact boxes (N, 3) of the ellipsoids: along an axis, an ellipsoid extends by n sqrt(Σ_ii)."""
    q = model.quats.double().numpy()
    w, x, y, z = (q / np.linalg.norm(q, axis=1, keepdims=True)).T
    R = np.stack(
        [
            np.stack([w * w + x * x - y * y - z * z, 2 * (x * y - w * z), 2 * (x * z + w * y)], axis=1),
            np.stack([2 * (x * y + w * z), w * w - x * x + y * y - z * z, 2 * (y * z - w * x)], axis=1),
            np.stack([2 * (x * z - w * y), 2 * (y * z + w * x), w * w - x * x - y * y + z * z], axis=1),
        ],
        axis=1,
    )
    half = n_sigma * np.sqrt(((R * np.exp(model.log_scales.double().numpy())[:, None, :]) ** 2).sum(axis=2))
    means = model.means.double().numpy()
    return means - half, means + half

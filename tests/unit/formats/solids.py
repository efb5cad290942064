"""Oracle of containment of ellipsoids in float64, and hard maps for it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from splatbot.collision.solids import SCALE_FLOOR
from splatbot.gaussians import GaussianModel

Array = NDArray[np.float64]

HARD = ("common", "needles", "discs", "balls", "tiny", "huge", "far", "wide", "twice", "one")


def hard_model(kind: str, n: int = 250, seed: int = 0) -> GaussianModel:
    """Return Gaussians [m] of a kind of :data:`HARD`, with their row as anchor."""
    rng = np.random.default_rng(seed)
    n = 1 if kind == "one" else n
    means, scales = rng.uniform(-1.0, 1.0, (n, 3)), np.exp(rng.uniform(-9.0, -3.0, (n, 3)))
    if kind == "needles":
        scales = 1e-4 * rng.permuted(np.tile([1.0, 1.0, 1e4], (n, 1)), axis=1)
    elif kind == "discs":
        scales = 1e-4 * rng.permuted(np.tile([1.0, 1e3, 1e3], (n, 1)), axis=1) * rng.uniform(0.9, 1.1, (n, 3))
    elif kind == "balls":
        scales = np.tile(scales[:, :1], 3)
    elif kind == "tiny":
        scales *= 1e-8
    elif kind == "huge":
        scales *= 1e6
    elif kind == "far":
        means += (1000.0, -700.0, 300.0)
    elif kind == "wide":
        means *= 4e5 * rng.integers(0, 2, (n, 1))
    elif kind == "twice":
        means = means[np.arange(n) // 4]

    def tensor(values: Array) -> torch.Tensor:
        return torch.from_numpy(values.astype(np.float32))

    return GaussianModel(
        means=tensor(means),
        quats=tensor(rng.normal(size=(n, 4))),
        log_scales=tensor(np.log(scales)),
        opacity_logits=tensor(rng.uniform(-8.0, 8.0, n)),
        sh=tensor(rng.normal(size=(n, 1, 3))),
        observations=torch.from_numpy(rng.integers(0, 40, n).astype(np.int32)),
        anchors=torch.arange(n, dtype=torch.int32),
        uncertainty=tensor(rng.uniform(0.0, 0.02, n) * rng.integers(0, 2, n)),
        misses=torch.from_numpy(rng.integers(0, 3, n).astype(np.int32)),
    )


def axes_of(model: GaussianModel) -> Array:
    """Return the semi-axes (N, 3, 3) [m] at one standard deviation as columns, with the floor of collision fields."""
    rotation = Rotation.from_quat(model.quats.numpy().astype(np.float64)[:, [1, 2, 3, 0]]).as_matrix()
    return rotation * np.maximum(np.exp(model.log_scales.numpy().astype(np.float64)), SCALE_FLOOR)[:, None, :]


def farthest(inner: GaussianModel, outer: GaussianModel, n_sigma: float) -> Array:
    """Return how far each ellipsoid of ``inner`` reaches in the one of ``outer`` (N,): at most 1 if it is inside.

    The map to the unit ball of the outer one takes the inner one to the points A x + b. The farthest of these is found
    by ascent from the ends of all axes, which converges because the squared length is convex in x.
    """
    to_ball = np.linalg.inv(axes_of(outer))
    A = to_ball @ axes_of(inner)
    shift = inner.means.numpy().astype(np.float64) - outer.means.numpy().astype(np.float64)
    b = np.einsum("nij,nj->ni", to_ball, shift)[:, None] / n_sigma
    ends = np.linalg.svd(A)[2]
    x = np.concatenate([ends, -ends], axis=1)
    for _ in range(100):
        x = np.einsum("nij,nkj->nki", A, x) + b
        x = np.einsum("nij,nki->nkj", A, x)
        x /= np.linalg.norm(x, axis=2, keepdims=True)
    return np.asarray(np.linalg.norm(np.einsum("nij,nkj->nki", A, x) + b, axis=2).max(axis=1))

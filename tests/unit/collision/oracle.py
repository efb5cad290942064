"""Independent oracles of distances to ellipsoids, in float64."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

from splatbot.collision.solids import SCALE_FLOOR
from splatbot.gaussians import GaussianModel

Array = NDArray[np.float64]


def gaussians(
    means: ArrayLike, scales: ArrayLike, quats: ArrayLike | None = None, opacities: ArrayLike | None = None
) -> GaussianModel:
    """Return a grey model of Gaussians; scales (3,) are shared."""
    m = np.atleast_2d(np.asarray(means, dtype=np.float64))
    n = len(m)
    return GaussianModel.from_activated(
        means=m,
        scales=np.broadcast_to(np.asarray(scales, dtype=np.float64), (n, 3)).copy(),
        quats=np.tile([1.0, 0, 0, 0], (n, 1)) if quats is None else np.asarray(quats),
        opacities=np.full(n, 0.9) if opacities is None else np.asarray(opacities),
        colors=np.full((n, 3), 0.5),
    )


def random_gaussians(n: int, rng: np.random.Generator, least: float = 1e-3, most: float = 0.05) -> GaussianModel:
    """Return Gaussians in a box of 2 m, with log-uniform scales in ``least``..``most`` [m] and any rotation."""
    scales = np.exp(rng.uniform(np.log(least), np.log(most), (n, 3)))
    return gaussians(rng.uniform(-1, 1, (n, 3)), scales, rng.normal(size=(n, 4)))


def moved(model: GaussianModel, turn: Rotation, shift: float = 0.0) -> GaussianModel:
    """Return a grey copy, turned around the origin and then shifted [m] along every axis."""
    return gaussians(
        turn.apply(model.means.double().numpy()) + shift,
        model.scales.double().numpy(),
        (turn * Rotation.from_quat(model.quats.double().numpy(), scalar_first=True)).as_quat(scalar_first=True),
    )


def local(model: GaussianModel, n_sigma: float, points: Array) -> tuple[Array, Array]:
    """Transform points (P, 3) to the frames of the Gaussians (P, N, 3); return also the semi-axes (N, 3)."""
    R = Rotation.from_quat(model.quats.double().numpy(), scalar_first=True).as_matrix()
    axes = n_sigma * np.maximum(model.log_scales.double().exp().numpy(), SCALE_FLOOR)
    return np.einsum("nij,pni->pnj", R, points[:, None] - model.means.double().numpy()), axes


def signed_distances(v: Array, a: Array) -> Array:
    """Compute signed distances (...) of points ``v`` (..., 3) to axis-aligned ellipsoids ``a`` (..., 3), by bisection.

    The root t of Σ (a_i v_i / (a_i² + t))² = 1 in t > -min(a)² (Eberly, distance from a point to an ellipsoid).
    """
    v, a = (np.asarray(x, dtype=np.longdouble) for x in np.broadcast_arrays(np.abs(v), a))  # type: ignore[assignment]
    least = a.min(axis=-1, keepdims=True)
    v = np.where(a <= least, np.maximum(v, 1e-12 * least), v)
    D = (a - least) * (a + least)
    low = (a * v - D).max(axis=-1)
    high = np.maximum(np.linalg.norm((a * v).astype(np.float64), axis=-1).astype(np.longdouble), low)
    for _ in range(200):
        middle = (low + high) / 2
        if not ((low < middle) & (middle < high)).any():  # no number lies between
            break
        outside = ((a * v / (D + middle[..., None])) ** 2).sum(axis=-1) > 1
        low, high = np.where(outside, middle, low), np.where(outside, high, middle)
    s = (low + high)[..., None] / 2
    t = s - least * least
    return np.asarray(t[..., 0] * np.sqrt(((v / (D + s)) ** 2).sum(axis=-1)), dtype=np.float64)


def separation(v: Array, a: Array, r: Array) -> Array:
    """Compute the largest K(s), s in 0..1, of spheres of radius ``r`` (...) at ``v`` (..., 3); above 1 they are apart.

    K(s) = Σ v_i² s (1 - s) / (r² + s (a_i² - r²)), concave in s (Splat-Nav, Chen et al. 2024, proposition 1).
    """
    squares, spread, ball = v**2, a**2 - r[..., None] ** 2, r[..., None] ** 2
    low, high = np.zeros(v.shape[:-1]), np.ones(v.shape[:-1])

    def K(s: Array) -> Array:
        return (squares * (s * (1 - s))[..., None] / (ball + s[..., None] * spread)).sum(axis=-1)

    for _ in range(100):  # thirds
        left, right = low + (high - low) / 3, high - (high - low) / 3
        uphill = K(left) < K(right)
        low, high = np.where(uphill, left, low), np.where(uphill, high, right)
    return K((low + high) / 2)

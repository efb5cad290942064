"""Collision probability of a sphere and a map whose Gaussians have uncertain positions."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

from splatbot.collision.field import GaussianCollisionField
from splatbot.collision.inputs import as_float64
from splatbot.errors import InputError
from splatbot.protocols import Array

_NEIGHBOURS = 64  # Gaussians whose probabilities are summed; the rest is bounded


@dataclass(frozen=True)
class ProbabilityResult:
    """Bounds of the collision probability of P spheres, valid for any correlation between the Gaussians' errors.

    Args:
        lower: (P,) largest probability of any single Gaussian.
        upper: (P,) sum over all Gaussians (Boole's inequality), at most 1.
        map_version: version of the map.
    """

    lower: Array
    upper: Array
    map_version: int


def collision_probability(
    field: GaussianCollisionField, spheres: ArrayLike | Tensor, sigma: ArrayLike | Tensor | float
) -> ProbabilityResult:
    """Bound the probability that a sphere collides with the map.

    The position error of Gaussian i is N(0, σᵢ²) along any direction. With the clearance dᵢ::

        P(collision with i) = Φ(-dᵢ / σᵢ)
        max_i P_i <= P <= Σ_i P_i

    The sum runs over the nearest 64 Gaussians. All others are bounded by Φ at the 64th distance and the largest σ.

    Args:
        field: collision field.
        spheres: (P, 4) = (x, y, z, radius) or points (P, 3) [m, world].
        sigma: standard deviation of each row of the model (N,), or one for all [m].

    Raises:
        InputError: sigma is not above 0, or does not fit the model.
    """
    deviations = as_float64(sigma)
    if deviations.ndim > 1 or not (np.isfinite(deviations).all() and (deviations > 0).all()):
        raise InputError("must be finite and above 0.", field="sigma", hint="give metres, one or (N,)")
    if deviations.ndim == 1 and len(deviations) != field.rows:
        raise InputError(f"has {len(deviations)} values.", field="sigma", hint=f"the model has {field.rows} rows")
    near = field.nearest(spheres, _NEIGHBOURS)
    own = deviations[np.maximum(near.index, 0)] if deviations.ndim else np.full(near.index.shape, float(deviations))
    each = np.where(near.index >= 0, _normal_cdf(-near.distance / own), 0.0)
    tail = (len(field) - _NEIGHBOURS) * _normal_cdf(-near.distance[:, -1] / deviations.max())
    rest = np.where(near.index[:, -1] >= 0, np.maximum(tail, 0.0), 0.0)
    return ProbabilityResult(each.max(axis=1), np.minimum(1.0, each.sum(axis=1) + rest), field.map_version)


def _normal_cdf(x: Array) -> Array:
    """Compute Φ(x), the cumulative standard normal distribution."""
    import torch

    return np.asarray(torch.special.ndtr(torch.from_numpy(np.asarray(x, dtype=np.float64))).numpy())

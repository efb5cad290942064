"""How likely a sphere touches the map, if each Gaussian's place is known to within a standard deviation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

from splatbot.collision.field import GaussianCollisionField
from splatbot.collision.inputs import as_float64
from splatbot.errors import InputError
from splatbot.protocols import Array

_NEIGHBOURS = 64


@dataclass(frozen=True)
class ProbabilityResult:
    """Bounds for P spheres; they hold whatever the Gaussians' errors have to do with each other.

    Args:
        lower: (P,), of the likeliest Gaussian alone.
        upper: (P,), of the sum over all (Boole's inequality), at most 1.
        map_version: the state of the map that was asked.
    """

    lower: Array
    upper: Array
    map_version: int


def collision_probability(
    field: GaussianCollisionField, spheres: ArrayLike | Tensor, sigma: ArrayLike | Tensor | float
) -> ProbabilityResult:
    """P(a Gaussian, moved by its error along the line to the sphere, touches it) = Φ(-d / σ), d the clearance.

    Gaussian i's place is taken to be off by N(0, σᵢ²) along any direction. The nearest 64 Gaussians are summed;
    what may lie beyond is bounded by the map's number of Gaussians at the 64th distance and the largest σ.

    Args:
        field: the map.
        spheres: (P, 4) = (x, y, z, radius) or points (P, 3) [m, world].
        sigma: standard deviation [m] of each row of the model (N,), or one for all.

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
    each = np.where(near.index >= 0, _below(-near.distance / own), 0.0)
    beyond = (len(field) - _NEIGHBOURS) * _below(-near.distance[:, -1] / deviations.max())
    rest = np.where(near.index[:, -1] >= 0, np.maximum(beyond, 0.0), 0.0)
    return ProbabilityResult(each.max(axis=1), np.minimum(1.0, each.sum(axis=1) + rest), field.map_version)


def _below(x: Array) -> Array:
    """Φ(x), the standard normal distribution."""
    import torch

    return np.asarray(torch.special.ndtr(torch.from_numpy(np.asarray(x, dtype=np.float64))).numpy())

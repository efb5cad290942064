"""Distances between points that a user clicks in the viewer."""

from __future__ import annotations

import numpy as np
import torch

from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import covariances
from splatbot.protocols import Array

_NEAR = 0.5  # [m] distance of a Gaussian's centre from the ray, beyond which it is not evaluated
_OPAQUE = 0.5  # opacity along the ray at which the surface lies


def surface_point(model: GaussianModel, origin: Array, direction: Array) -> Array | None:
    """Return the point (3,) [m] at which a ray meets the surface of a map, or None if it meets none.

    The surface lies where the accumulated opacity 1 - Π (1 - α_i) passes 0.5. Gaussian i contributes
    α_i = o_i exp(-m_i / 2), with m_i the smallest squared Mahalanobis distance along the ray, at
    t_i = dᵀ Σ_i⁻¹ (μ_i - o) / dᵀ Σ_i⁻¹ d.

    Args:
        model: the map.
        origin: (3,) of the ray [m].
        direction: (3,) of the ray.
    """
    o, d = np.asarray(origin, np.float64), np.asarray(direction, np.float64)
    d = d / np.linalg.norm(d)
    offset = model.means.double().numpy() - o
    along = offset @ d
    rows = np.flatnonzero((along > 0) & (np.linalg.norm(offset - along[:, None] * d, axis=1) < _NEAR))
    if not len(rows):
        return None
    near = model.select(torch.from_numpy(rows))
    inverse = np.linalg.inv(covariances(near).double().numpy() + 1e-12 * np.eye(3))
    toward = inverse @ d
    t = np.einsum("ni,ni->n", offset[rows], toward) / (toward @ d)
    beside = offset[rows] - t[:, None] * d
    m = np.einsum("ni,nij,nj->n", beside, inverse, beside)
    alpha = near.opacities.double().numpy() * np.exp(-m / 2) * (t > 0)
    order = np.argsort(t)
    seen = 1 - np.cumprod(1 - alpha[order])
    first = int(np.searchsorted(seen, _OPAQUE))
    return None if first == len(order) else np.asarray(o + t[order[first]] * d)

"""Hulls of groups of Gaussians: ellipsoids that enclose their members at 2 and more standard deviations.

A hull has the axes, and the ratios of the scales, of the mean and covariance of its members. It grows until it encloses
each of them. With the hull as the unit ball, a member is A x + b for all x of the unit ball. For each p > 0, it is part
of the centred ellipsoid of the matrix ``(1 + p) A Aᵀ + (1 + 1 / p) b bᵀ``, as in :mod:`splatbot.formats.enclosing`. At
n standard deviations, b is b / n, so that the least n is the hardest case.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.collision.solids import SCALE_FLOOR
from splatbot.gaussians import GaussianModel
from splatbot.geometry import quat_to_rotation, rotation_to_quat

Array = NDArray[np.float64]
Ints = NDArray[np.int64]


@dataclass(frozen=True)
class HullConstants:
    """Constants of hulls.

    Args:
        n_sigma: least number of standard deviations at which hulls enclose their members: that of a collision field.
        slack: share of the semi-axes that is left for the float32 rounding of a field.
        p: candidates of p; the first one is for a member at the centre.
    """

    n_sigma: float = 2.0
    slack: float = 2.0**-10
    p: tuple[float, ...] = (1e-6, 0.25, 0.5, 1.0, 2.0, 4.0)


CONSTANTS = HullConstants()


@dataclass(frozen=True, eq=False)
class Hulls:
    """Ellipsoids of one standard deviation.

    Args:
        means: (H, 3) [m], values of float32.
        quats: (H, 4) wxyz, values of float32.
        scales: (H, 3) [m].
    """

    means: Array
    quats: Array
    scales: Array


def enclosing_hulls(model: GaussianModel, groups: Ints, n: int) -> Hulls:
    """Return the hull of each group of Gaussians.

    Args:
        model: N Gaussians.
        groups: (N,) group of each, 0 to n - 1.
        n: number of groups, none of them empty.
    """
    means = model.means.double().numpy()
    semi_axes = np.maximum(model.scales.double().numpy(), SCALE_FLOOR)
    roots = quat_to_rotation(model.quats.double().numpy()) * semi_axes[:, None, :]
    sizes = np.bincount(groups, minlength=n)[:, None]
    centres = group_sums(means, groups, n) / sizes
    away = means - centres[groups]
    moments = np.matmul(roots, roots.transpose(0, 2, 1)) + away[:, :, None] * away[:, None, :]
    values, axes = np.linalg.eigh((group_sums(moments.reshape(-1, 9), groups, n) / sizes).reshape(-1, 3, 3))
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]  # eigenvectors may be left-handed
    scales = np.sqrt(np.maximum(values, SCALE_FLOOR**2))
    # rounded to the precision of files before the growth is found, so that rounding cannot uncover a member
    centres = centres.astype(np.float32).astype(np.float64)
    quats = rotation_to_quat(axes).reshape(-1, 4).astype(np.float32).astype(np.float64)
    growth = np.zeros(n)
    reach = _reach(means - centres[groups], roots, quat_to_rotation(quats)[groups], scales[groups])
    np.maximum.at(growth, groups, reach)
    return Hulls(centres, quats, scales * (growth / (1.0 - CONSTANTS.slack))[:, None])


def group_sums(values: Array, groups: Ints, n: int) -> Array:
    """Return the sums (n, C) of rows (N, C) by group."""
    return np.stack([np.bincount(groups, column, n) for column in values.T], axis=1)


def _reach(away: Array, roots: Array, axes: Array, scales: Array) -> Array:
    """Return by how much (N,) outer ellipsoids must grow to enclose inner ones, whose means are ``away`` from them."""
    to_ball = axes.transpose(0, 2, 1) / scales[:, :, None]
    A, b = np.matmul(to_ball, roots), np.einsum("nij,nj->ni", to_ball, away) / CONSTANTS.n_sigma
    AA, bb = np.matmul(A, A.transpose(0, 2, 1)), b[:, :, None] * b[:, None, :]
    squares = [np.linalg.eigvalsh((1.0 + p) * AA + (1.0 + 1.0 / p) * bb)[:, 2] for p in CONSTANTS.p]
    return np.sqrt(np.min(squares, axis=0))

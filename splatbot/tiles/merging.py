"""Coarser levels of detail: neighbours in a cell of a grid become one Gaussian of their moments."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import torch

from splatbot.collision.hulls import group_sums
from splatbot.gaussians import GaussianModel
from splatbot.gaussians.model import OPACITY_MIN, SCALE_MIN
from splatbot.geometry import quat_to_rotation, rotation_to_quat
from splatbot.protocols import Array
from splatbot.tiles.part import MapPart

Ints = np.ndarray[tuple[int, ...], np.dtype[np.int64]]


@dataclass(frozen=True)
class MergingConstants:
    """Constants of merging.

    Args:
        widest: largest standard deviation of a Gaussian that is merged, in edges of a cell.
        octaves: range of the search for the edge, downwards from the size of the part.
        steps: of the bisection.
        most_opacity: largest opacity of a merged Gaussian.
    """

    widest: float = 0.5
    octaves: float = 30.0
    steps: int = 9
    most_opacity: float = 0.99


CONSTANTS = MergingConstants()


def merged(part: MapPart, most: int, least_edge: float = 0.0) -> tuple[MapPart, float]:
    """Return a part of at most about ``most`` Gaussians, and the edge of its cells [m].

    The edge is the least, by bisection of its logarithm, that leaves few enough cells. Gaussians that are wide for a
    cell stay as they are.

    Args:
        part: one or more Gaussians.
        most: 8 or more.
        least_edge: of the cells [m].
    """
    means, scales = part.model.means.double().numpy(), part.model.scales.amax(1).double().numpy()
    largest = max(2.0 * float(np.ptp(means, axis=0).max()), 2.0 * float(scales.max()), least_edge) * 1.001
    high = np.log2(largest)
    low = max(high - CONSTANTS.octaves, np.log2(least_edge) if least_edge > 0 else -np.inf)
    for _ in range(CONSTANTS.steps):
        middle = 0.5 * (low + high)
        if _cells(means, scales, 2.0**middle)[1] > most:
            low = middle
        else:
            high = middle
    edge = float(2.0**high)
    return _of_moments(part, _cells(means, scales, edge)[0]), edge


def _cells(means: Array, scales: Array, edge: float) -> tuple[Ints, int]:
    """Return the number of the group (N,) of each Gaussian, and that of groups; a wide Gaussian is a group."""
    key = np.zeros(len(means), np.int64)
    for column in np.floor((means - means.min(axis=0)) / edge).T:
        places, rank = np.unique(column, return_inverse=True)
        key = key * len(places) + rank
    key = np.where(scales <= CONSTANTS.widest * edge, key, -1 - np.arange(len(means)))
    groups, of = np.unique(key, return_inverse=True)
    return of, len(groups)


def _of_moments(part: MapPart, of: Ints) -> MapPart:
    """Return one Gaussian for each group: mean, covariance and colour by opacity times area, and their sum as opacity.

    Without members of its own, no keyframe supports it: a collision field ignores it.
    """
    single = np.bincount(of)[of] == 1
    alone, members = part.select(torch.from_numpy(single)), part.select(torch.from_numpy(~single))
    if not len(members):
        return alone
    groups, of = np.unique(of[~single], return_inverse=True)
    model, n = members.model, len(groups)
    means, scales = model.means.double().numpy(), np.exp(model.log_scales.double().numpy()).clip(SCALE_MIN)
    mass = model.opacities.double().numpy().clip(OPACITY_MIN) * _area(scales)
    total = np.bincount(of, mass, n)
    share = (mass / total[of])[:, None]
    centres = group_sums(share * means, of, n)
    roots = quat_to_rotation(model.quats.double().numpy()) * scales[:, None, :]
    away = means - centres[of]
    moments = np.matmul(roots, roots.transpose(0, 2, 1)) + away[:, :, None] * away[:, None, :]
    values, axes = np.linalg.eigh(group_sums(share * moments.reshape(-1, 9), of, n).reshape(-1, 3, 3))
    axes[:, :, 0] *= np.linalg.det(axes)[:, None]  # eigenvectors may be left-handed
    sigmas = np.sqrt(np.maximum(values, SCALE_MIN**2))
    opacities = np.clip(total / _area(sigmas), OPACITY_MIN, CONSTANTS.most_opacity)
    sh = group_sums(share * model.sh.double().numpy().reshape(len(model), -1), of, n)
    first = np.full(n, np.iinfo(np.int32).max, np.int32)
    np.minimum.at(first, of, members.rows.numpy())
    joint = GaussianModel(
        means=torch.from_numpy(centres).float(),
        quats=torch.from_numpy(rotation_to_quat(axes).reshape(-1, 4)).float(),
        log_scales=torch.from_numpy(np.log(sigmas)).float(),
        opacity_logits=torch.logit(torch.from_numpy(opacities)).float(),
        sh=torch.from_numpy(sh.reshape(n, -1, 3)).float(),
        observations=torch.zeros(n, dtype=torch.int32),
        anchors=torch.full((n,), -1, dtype=torch.int32),
    )
    return MapPart.union([alone, MapPart(joint, torch.from_numpy(first))])


def _area(scales: Array) -> Array:
    """Return the product of the two largest standard deviations (N,) [m²]."""
    return np.asarray(scales.prod(axis=1) / scales.min(axis=1))

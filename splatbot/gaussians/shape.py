"""Orientation and extent of Gaussians, in the world frame."""

from __future__ import annotations

import torch
from torch import Tensor

from splatbot.gaussians.model import GaussianModel


def rotations(model: GaussianModel) -> Tensor:
    """Return the rotations R_world_gaussian (N, 3, 3)."""
    w, x, y, z = torch.nn.functional.normalize(model.quats, dim=1).T
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], 1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], 1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], 1),
    ]
    return torch.stack(rows, 1)


def shortest_axes(model: GaussianModel, rows: Tensor | None = None) -> Tensor:
    """Return unit vectors (M, 3): the axis of the least scale of each Gaussian, or of those that ``rows`` (M,) name."""
    quats, scales = (x if rows is None else x.index_select(0, rows) for x in (model.quats, model.log_scales))
    quats = torch.nn.functional.normalize(quats, dim=1)
    w, v = quats[:, :1], quats[:, 1:]
    axis = torch.nn.functional.one_hot(scales.argmin(1), 3).to(quats.dtype)
    twice = 2 * torch.linalg.cross(v, axis)
    return axis + w * twice + torch.linalg.cross(v, twice)


def covariances(model: GaussianModel) -> Tensor:
    """Return the covariances Σ = R S Sᵀ Rᵀ (N, 3, 3) [m²]."""
    half = rotations(model) * model.scales[:, None, :]
    return half @ half.transpose(1, 2)

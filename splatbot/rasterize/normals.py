"""Normals of Gaussians: the shortest axis, turned towards the camera."""

from __future__ import annotations

import torch
from torch import Tensor


def facing_axes(means: Tensor, quats: Tensor, scales: Tensor, viewmats: Tensor, *, parallel: bool = False) -> Tensor:
    """Return unit normals (C, N, 3), world frame, of N Gaussians facing C cameras; differentiable in ``quats``.

    Args:
        means: (N, 3) [m], world frame.
        quats: (N, 4) wxyz, any norm; a zero quaternion counts as no rotation and receives no gradient.
        scales: (N, 3) [m]; of equal ones, the first is the shortest.
        viewmats: (C, 4, 4) world to camera.
        parallel: rays run along the camera's axis (orthographic) instead of from its centre.
    """
    shortest = scales.detach().abs().argmin(-1)
    axes = _axes(quats)[torch.arange(len(quats)), :, shortest]  # (N, 3)
    with torch.no_grad():
        T = viewmats.double()
        if parallel:
            rays = T[:, None, 2, :3].expand(-1, len(means), -1)
        else:
            centers = -torch.linalg.solve(T[:, :3, :3], T[:, :3, 3:])[..., 0]
            rays = means.double() - centers[:, None]
        away = (axes.double() * rays).sum(-1, keepdim=True) > 0
    return torch.where(away, -axes, axes)


def _axes(quats: Tensor) -> Tensor:
    """Return the rotation matrices (N, 3, 3); the columns are the Gaussians' axes."""
    largest = quats.detach().abs().amax(-1, keepdim=True)  # squares of 1e-20 and 1e20 leave the range of a float
    zero = largest < 1e-30
    identity = quats.new_tensor([1.0, 0.0, 0.0, 0.0])
    scaled = torch.where(zero, identity, quats / torch.where(zero, torch.ones_like(largest), largest))
    w, x, y, z = torch.nn.functional.normalize(scaled, dim=-1).unbind(-1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)

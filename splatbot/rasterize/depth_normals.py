"""Normals of the surface that a depth image shows."""

from __future__ import annotations

import torch
from torch import Tensor


def depth_to_normal(depths: Tensor, viewmats: Tensor, Ks: Tensor) -> Tensor:
    """Compute world normals (C, H, W, 3) of depth images (C, H, W, 1) [m]; differentiable.

    A normal is the cross product of the central differences of neighbouring points, of length one, facing the camera.
    It is zero at the image's border and where the neighbours coincide (no depth).

    Args:
        depths: along the optical axis [m]; 0 for none.
        viewmats: (C, 4, 4) world to camera, rigid.
        Ks: (C, 3, 3) [px], pixel centres at +0.5.
    """
    if min(depths.shape[1:3]) < 3:
        return depths.new_zeros(*depths.shape[:3], 3)
    points = _camera_points(depths, Ks)
    down = points[:, 2:, 1:-1] - points[:, :-2, 1:-1]
    right = points[:, 1:-1, 2:] - points[:, 1:-1, :-2]
    inner = torch.nn.functional.normalize(torch.linalg.cross(down, right, dim=-1), dim=-1, eps=1e-20)
    in_world = inner @ viewmats[:, None, :3, :3].to(depths.dtype)
    return torch.nn.functional.pad(in_world, (0, 0, 1, 1, 1, 1))


def _camera_points(depths: Tensor, Ks: Tensor) -> Tensor:
    """Return the points (C, H, W, 3) [m] in the camera frame."""
    height, width = depths.shape[1:3]
    fx, fy, cx, cy = (Ks[:, i, j, None, None].to(depths.dtype) for i, j in ((0, 0), (1, 1), (0, 2), (1, 2)))
    u = (torch.arange(width, dtype=depths.dtype)[None, None, :] + 0.5 - cx) / fx
    v = (torch.arange(height, dtype=depths.dtype)[None, :, None] + 0.5 - cy) / fy
    z = depths[..., 0]
    return torch.stack([u * z, v * z, z], -1)

"""Pixels that show points."""

from __future__ import annotations

import torch
from torch import Tensor

from splatbot.camera import Camera

LEAST_Z = 0.05  # [m]; points nearer to the camera are outside its image


def pixels_of(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Round the projections of points (N, 3) of the camera frame: columns, rows [px], and whether they are inside."""
    z = points[:, 2].clamp_min(1e-6)
    u = torch.round(camera.fx * points[:, 0] / z + camera.cx)
    v = torch.round(camera.fy * points[:, 1] / z + camera.cy)
    inside = (points[:, 2] > LEAST_Z) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    return torch.where(inside, u, 0.0), torch.where(inside, v, 0.0), inside

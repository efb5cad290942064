"""Limits that keep Gaussians on the surface that depth measured, while colours are fitted."""

from __future__ import annotations

import math

import torch
from torch import Tensor

from splatbot.gaussians import GaussianModel


def limit_normal_motion(model: GaussianModel, rows: Tensor, means: Tensor, normals: Tensor, scale: float) -> None:
    """Scale the part of a step that moves means along their normals, in place: μ' = μ + Δ - (1 - s) (nᵀ Δ) n.

    Depth fusion estimates the position along the normal from all depth images and their noise. An iteration uses one
    image, whose colors hardly constrain the distance of a plain wall. Colors do constrain the position along the
    surface.

    Args:
        model: after the step.
        rows: (M,) Gaussians that the step changed.
        means, normals: (M, 3) before the step, [m] and unit vectors.
        scale: s, 0 to 1.
    """
    after = model.means.index_select(0, rows)
    along = ((after - means) * normals).sum(1, keepdim=True)
    model.means.index_copy_(0, rows, after.addcmul_(along, normals, value=scale - 1))


def limit_shape(
    model: GaussianModel, rows: Tensor, viewmat: Tensor, focal: float, *, max_pixels: float, thickness: float
) -> None:
    """Keep Gaussians thin discs of a bounded size in a view, in place.

    The photometric loss does not: a needle in front of a plain wall changes no pixel, and a sphere looks like its disc.
    But both reach into free space, and a sphere has no normal.

    Args:
        model: the map.
        rows: (M,) Gaussians in view.
        viewmat: (4, 4) T_camera_world.
        focal: focal length [px].
        max_pixels: largest standard deviation in the view [px].
        thickness: largest ratio of the shortest and the middle axis.
    """
    pose = viewmat.to(torch.float32)
    z = model.means[rows] @ pose[2, :3] + pose[2, 3]
    limit = (max_pixels * z / focal).log()
    sizes, axes = torch.minimum(model.log_scales[rows], limit[:, None]).sort(1)
    sizes[:, 0] = torch.minimum(sizes[:, 0], sizes[:, 1] + math.log(thickness))
    model.log_scales[rows] = torch.empty_like(sizes).scatter_(1, axes, sizes)

"""The surfel rasterizer's model in plain torch, in any float type: the oracle that the native kernels are tested
against. It follows the paper's homographies, which the kernels do not. For small scenes only.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize.depth_normals import depth_to_normal
from splatbot.rasterize.reference import (
    ALPHA_MAX,
    ALPHA_MIN,
    TRANSMITTANCE_MIN,
    _check_mode,
    _colors_of_view,
    _margins,
    _pixel_centers,
    _planes,
    _views_of,
    reference_rotations,
)
from splatbot.rasterize.scene import Gaussians, Viewpoints

FILTER = 2.0  # 1 / variance of the screen-space low-pass filter [px⁻²]
LEAST_SCALE = 1e-6  # [px] a thinner disc counts as this thick: below, only the low-pass filter is seen
EXPECTED_DEPTH_MIN = 1e-10


@dataclass(frozen=True)
class SurfelReferenceMeta:
    """Intermediate results of the reference.

    Args:
        means2d: (C, N, 2) projected centres [px].
        depths: (C, N) of the centres [m].
        margins: (C, H, W) relative distance of each pixel from its nearest jump. Jumps are an alpha at 1/255 or at its
            cap, a transmittance at 1e-4 or (for the median) at 1/2, a hit at the near plane. Further jumps are a disc's
            response equal to the low-pass filter's, and a hit at the mean depth of the earlier ones (for distortion).
    """

    means2d: Tensor
    depths: Tensor
    margins: Tensor


@dataclass(frozen=True)
class _Hits:
    """Hits of P pixels with M surfels, front to back."""

    power: Tensor  # (M, P) opacity x falloff, before the cap
    depth: Tensor  # (M, P)
    margin: Tensor  # (M, P) from the jumps of depth


def rasterization_2dgs_reference(
    surfels: Gaussians,
    viewpoints: Viewpoints,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    render_mode: str = "RGB",
    distloss: bool = False,
    depth_mode: Literal["expected", "median"] = "expected",
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor | None, Tensor, SurfelReferenceMeta]:
    """Render as :func:`splatbot.rasterize.rasterization_2dgs`, computed in the type of the means by torch alone.

    Raises:
        InputError: an unknown render mode, or the surfels have no axes.
    """
    _check_mode(render_mode)
    means, quats, scales = surfels.means, surfels.quats, surfels.scales
    if quats is None or scales is None:
        raise InputError("are missing.", field="quats, scales", hint="give the axes of the surfels")
    near, far = _planes(near_plane, far_plane)
    width, height = viewpoints.width, viewpoints.height
    pixels = _pixel_centers(width, height, means)
    views = []
    for i, view in enumerate(_views_of(viewpoints)):
        shown, background = _colors_of_view(surfels, viewpoints, i, render_mode)
        R, t = view.viewmat[:3, :3], view.viewmat[:3, 3]
        centers = means @ R.T + t
        axes = R @ reference_rotations(quats)
        z = centers[:, 2]
        order = torch.argsort(z.detach().float(), stable=True)
        order = order[((z >= near) & (z <= far))[order]]
        hits = _hit(centers[order], axes[order], scales[order], surfels.opacities[order], view.K, pixels, near)
        facing = torch.where((axes[..., 2] * centers).sum(-1, keepdim=True) < 0, 1.0, -1.0).detach()
        normals = reference_rotations(quats)[..., 2] * facing
        images = _composite(
            hits, None if shown is None else shown[order], normals[order], background, render_mode, distloss
        )
        projected = torch.stack([view.K[k, k] * centers[:, k] / z + view.K[k, 2] for k in (0, 1)], -1)
        views.append((*(image.reshape(height, width, -1) for image in images), projected, z))
    render, alpha, normal, distort, median, ratio, margin, means2d, depths = (
        torch.stack(column) for column in zip(*views, strict=True)
    )
    surf_normals = None
    if "D" in render_mode:
        surf_normals = depth_to_normal(median if depth_mode == "median" else ratio, viewpoints.viewmats, viewpoints.Ks)
    meta = SurfelReferenceMeta(means2d, depths, margin[..., 0])
    return render, alpha, normal, surf_normals, distort if distloss else None, median, meta


def _hit(
    centers: Tensor, axes: Tensor, scales: Tensor, opacities: Tensor, K: Tensor, pixels: Tensor, near: float
) -> _Hits:
    """Intersect the pixels' rays with discs (Huang et al. 2024, eq. 8-10).

    With M = K (s₁t₁, s₂t₂, p), a pixel (x, y) lies on the planes x M₃ - M₁ and y M₃ - M₂ of the disc's frame. Their
    line meets the disc at (u, v).
    """
    z = centers[:, 2]
    fx, fy, cx, cy = K[0, 0], K[1, 1], K[0, 2], K[1, 2]  # the other entries are no parameters
    least = LEAST_SCALE * (z / fx).detach()
    s = torch.maximum(scales[:, :2].abs(), least[:, None])
    H = torch.stack([axes[:, :, 0] * s[:, :1], axes[:, :, 1] * s[:, 1:], centers], -1)
    M = torch.stack([fx * H[:, 0] + cx * H[:, 2], fy * H[:, 1] + cy * H[:, 2], H[:, 2]], 1)
    x, y = pixels[None, :, :1], pixels[None, :, 1:]
    cross = torch.linalg.cross(x * M[:, None, 2] - M[:, None, 0], y * M[:, None, 2] - M[:, None, 1], dim=-1)
    meets = cross[..., 2].abs() > 1e-300
    w = torch.where(meets, cross[..., 2], torch.ones_like(cross[..., 2]))
    u, v = cross[..., 0] / w, cross[..., 1] / w
    depth = u * M[:, 2, 0, None] + v * M[:, 2, 1, None] + M[:, 2, 2, None]
    meets = meets & (depth >= near)
    disc = torch.where(meets, u * u + v * v, torch.inf)
    d = pixels[None] - (M[:, :2, 2] / z[:, None])[:, None]
    point = FILTER * (d * d).sum(-1)
    on_disc = disc <= point
    power = opacities[:, None] * torch.exp(-0.5 * torch.where(on_disc, disc, point))
    switch = (disc / point.clamp_min(1e-30) - 1).abs()
    cut = torch.where(torch.minimum(u * u + v * v, point) == point, torch.inf, (depth / near - 1).abs())
    margin = torch.minimum(switch, cut).detach()
    return _Hits(power, torch.where(on_disc, depth, z[:, None]), margin)


def _composite(
    hits: _Hits,
    colors: Tensor | None,
    normals: Tensor,
    background: Tensor | None,
    render_mode: str,
    distloss: bool,
) -> tuple[Tensor, ...]:
    """Composite image (P, X), alpha, normal, distortion, median depth, expected depth, margin of P pixels."""
    counts = hits.power >= ALPHA_MIN
    alpha = torch.where(counts, hits.power.clamp_max(ALPHA_MAX), torch.zeros_like(hits.power))
    after = torch.cumprod(1.0 - alpha, 0)
    alpha = torch.where(after.detach() > TRANSMITTANCE_MIN, alpha, torch.zeros_like(alpha))
    through = torch.cat([torch.ones_like(alpha[:1]), torch.cumprod(1.0 - alpha, 0)])[: len(alpha) + 1]
    if len(alpha) == 0:
        through = torch.ones_like(hits.power.new_empty(1, hits.power.shape[1]))
    weights, left = alpha * through[:-1], through[-1]
    margin = _margins(hits.power.detach(), after.detach(), counts, TRANSMITTANCE_MIN)
    counted = weights.detach() > 0
    half = torch.where(counted, (through[:-1].detach() / 0.5 - 1).abs(), torch.inf)
    jumps = torch.where(counted, hits.margin, torch.inf)
    distort, distort_jumps = _distortion(weights, hits.depth)
    least = [margin] + [m.amin(0) for m in (half, jumps, *([distort_jumps] if distloss else [])) if len(m)]
    depth = (weights * hits.depth).sum(0)
    expected = depth / weights.sum(0).clamp_min(EXPECTED_DEPTH_MIN)
    columns = [] if colors is None else [(weights * c[:, None]).sum(0) for c in colors.unbind(-1)]
    if background is not None:
        columns = [image + left * b for image, b in zip(columns, background, strict=True)]
    if "D" in render_mode:
        columns.append(expected if "ED" in render_mode else depth)
    return (
        torch.stack(columns, -1),
        1.0 - left,
        torch.einsum("mp,mc->pc", weights, normals),
        distort,
        _median(hits.depth, counted & (through[:-1].detach() > 0.5)),
        expected,
        torch.stack(least).amin(0),
    )


def _median(depth: Tensor, front: Tensor) -> Tensor:
    """Return depth (P,) of the last surfel that found more than half of the light; or 0."""
    if len(depth) == 0:
        return depth.new_zeros(depth.shape[1])
    numbers = torch.arange(1, len(depth) + 1)[:, None] * front
    last = numbers.amax(0)
    picked = depth.gather(0, (last - 1).clamp_min(0)[None])[0]
    return torch.where(last > 0, picked, torch.zeros_like(picked))


def _distortion(weights: Tensor, depth: Tensor) -> tuple[Tensor, Tensor]:
    """Return 2 Σᵢ wᵢ |mᵢ Σ_{j<i} wⱼ - Σ_{j<i} wⱼ mⱼ| (P,), and each term's distance (M, P) to its kink."""
    before = torch.cumsum(weights, 0) - weights
    moment = torch.cumsum(weights * depth, 0) - weights * depth
    lag = depth * before - moment
    unclear = (lag / (depth * before).clamp_min(1e-12)).abs().detach()
    kink = torch.where((weights > 0) & (before > 1e-9), unclear, torch.inf)
    return 2.0 * (weights * lag.abs()).sum(0), kink

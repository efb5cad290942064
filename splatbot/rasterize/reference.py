"""The rasterizer's model in plain torch, in any float type: the oracle that the native kernels are tested against.

Every Gaussian is evaluated at every pixel, so it is for small scenes only.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize.harmonics import harmonics_basis
from splatbot.rasterize.scene import Gaussians, Viewpoints

ALPHA_MIN = 1.0 / 255.0
ALPHA_MAX = 0.99
TRANSMITTANCE_MIN = 1e-4
ANTIALIAS_MIN = 0.005
FOV_MARGIN = 0.3  # of half the field of view, where the slope of the projection is clamped


@dataclass(frozen=True)
class ReferenceMeta:
    """Intermediate results of the reference.

    Args:
        means2d: (C, N, 2) [px].
        covars2d: (C, N, 2, 2) [px²], blurred by eps2d.
        depths: (C, N) [m].
        margins: (C, H, W) relative distance of each pixel from its nearest jump: an alpha at 1/255, a transmittance at
            1e-4, an alpha at its cap. Rounding can put another implementation on the other side where it is tiny.
    """

    means2d: Tensor
    covars2d: Tensor
    depths: Tensor
    margins: Tensor


@dataclass(frozen=True)
class ReferenceProjection:
    """Projection of N Gaussians; those out of view have depth -1."""

    mean2d: Tensor  # (N, 2)
    sharp2d: Tensor  # (N, 2, 2) covariance before the blur
    covar2d: Tensor  # (N, 2, 2)
    depth: Tensor  # (N,)
    slope: Tensor  # (N, 2) change of depth per pixel


@dataclass(frozen=True)
class ReferenceView:
    """One view, seen from ``viewmat`` (4, 4) with the intrinsics ``K`` (3, 3)."""

    viewmat: Tensor
    K: Tensor
    width: int
    height: int


# Arguments: the Gaussians (covars, or quats and scales), the view, eps2d.
Projector = Callable[[Gaussians, ReferenceView, float], ReferenceProjection]


def rasterization_reference(
    gaussians: Gaussians,
    viewpoints: Viewpoints,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    eps2d: float = 0.3,
    render_mode: str = "RGB",
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    *,
    depth_mode: Literal["center", "plane"] = "center",
    transmittance_min: float = TRANSMITTANCE_MIN,
    project: Projector | None = None,
) -> tuple[Tensor, Tensor, ReferenceMeta]:
    """Render as :func:`splatbot.rasterize.rasterization`, computed in the type of the means by torch alone.

    Args and returns: see there, but without batch dimensions. Colours are (N, D), (C, N, D) or None, with a degree of
    harmonics (N, K, 3) or (C, N, K, 3). ``project``: another camera than the pinhole, see ``reference_cameras``.

    Raises:
        InputError: an unknown render mode.
    """
    _check_mode(render_mode)
    near, far = _planes(near_plane, far_plane)
    width, height = viewpoints.width, viewpoints.height
    pixels = _pixel_centers(width, height, gaussians.means)
    renders, alphas, metas = [], [], []
    for i, view in enumerate(_views_of(viewpoints)):
        view_colors, background = _colors_of_view(gaussians, viewpoints, i, render_mode)
        projected = _project(gaussians, view, eps2d, depth_mode) if project is None else project(gaussians, view, eps2d)
        antialiased = rasterize_mode == "antialiased"
        blended = gaussians.opacities * _antialias(projected) if antialiased else gaussians.opacities
        keep = (projected.depth >= near) & (projected.depth <= far)
        order = torch.argsort(projected.depth.detach().float(), stable=True)
        order = order[keep[order]]
        weights, left, margin = _blend(projected, blended, order, pixels, transmittance_min)
        channels = _channels(projected, view_colors, order, pixels, render_mode)
        image = _composite(weights, channels, left, background, render_mode)
        renders.append(image.reshape(height, width, -1))
        alphas.append((1.0 - left).reshape(height, width, 1))
        metas.append((projected.mean2d, projected.covar2d, projected.depth, margin.reshape(height, width)))
    meta = ReferenceMeta(*(torch.stack(column) for column in zip(*metas, strict=True)))
    return torch.stack(renders), torch.stack(alphas), meta


def _check_mode(render_mode: str) -> None:
    if render_mode not in ("RGB", "D", "ED", "RGB+D", "RGB+ED"):
        raise InputError(f"is {render_mode!r}.", field="render_mode", hint="one of RGB, D, ED, RGB+D, RGB+ED")


def _planes(near_plane: float, far_plane: float) -> tuple[float, float]:
    """Round the planes to float32, as the kernels hold them: a float32 Gaussian on the plane must be kept as well."""
    near, far = (float(torch.tensor(plane, dtype=torch.float32)) for plane in (near_plane, far_plane))
    return near, far


def _views_of(viewpoints: Viewpoints) -> list[ReferenceView]:
    size = viewpoints.width, viewpoints.height
    return [ReferenceView(viewmat, K, *size) for viewmat, K in zip(viewpoints.viewmats, viewpoints.Ks, strict=True)]


def _colors_of_view(
    gaussians: Gaussians, viewpoints: Viewpoints, i: int, render_mode: str
) -> tuple[Tensor | None, Tensor | None]:
    """Return the colours (N, D) and the background (D,) of view i, each None where the mode does not render it."""
    colors, sh_degree, backgrounds = gaussians.colors, gaussians.sh_degree, viewpoints.backgrounds
    if colors is None or "RGB" not in render_mode:
        return None, None
    shown = colors[i] if colors.ndim == (3 if sh_degree is None else 4) else colors
    if sh_degree is not None:
        shown = _shade(shown, sh_degree, gaussians.means, viewpoints.viewmats[i])
    return shown, None if backgrounds is None else backgrounds[i]


def _shade(coefficients: Tensor, degree: int, means: Tensor, viewmat: Tensor) -> Tensor:
    """Evaluate harmonics (N, K, 3) towards the camera as colours (N, 3)."""
    center = -torch.linalg.solve(viewmat[:3, :3], viewmat[:3, 3]).to(means.dtype)
    basis = harmonics_basis(torch.nn.functional.normalize(means - center, dim=-1), degree)
    return (0.5 + torch.einsum("nk,nkc->nc", basis, coefficients[:, : basis.shape[-1]])).clamp_min(0.0)


def _antialias(projected: ReferenceProjection) -> Tensor:
    """Factor (N,) on opacity for the area that the blur adds (Yu et al. 2024, eq. 9)."""
    squared = torch.linalg.det(projected.sharp2d) / torch.linalg.det(projected.covar2d)
    return squared.clamp_min(ANTIALIAS_MIN**2).sqrt()


def reference_rotations(quats: Tensor) -> Tensor:
    """Return the rotation matrices (N, 3, 3) of quaternions (N, 4) wxyz of any norm."""
    largest = quats.abs().amax(-1, keepdim=True)
    zero = largest < 1e-30
    identity = torch.tensor([1.0, 0.0, 0.0, 0.0], dtype=quats.dtype)
    q = torch.where(zero, identity, quats / torch.where(zero, torch.ones_like(largest), largest).detach())
    w, x, y, z = torch.unbind(q / q.norm(dim=-1, keepdim=True), -1)
    rows = [
        torch.stack([1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)], -1),
        torch.stack([2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)], -1),
        torch.stack([2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)], -1),
    ]
    return torch.stack(rows, -2)


def _project(gaussians: Gaussians, view: ReferenceView, eps2d: float, depth_mode: str) -> ReferenceProjection:
    """Project by EWA splatting (Zwicker et al. 2001, eq. 24 and 29)."""
    means, quats, scales = gaussians.means, gaussians.quats, gaussians.scales
    viewmat, K, width, height = view.viewmat, view.K, view.width, view.height
    W, t = viewmat[:3, :3].to(means.dtype), viewmat[:3, 3].to(means.dtype)
    fx, fy, cx, cy = (v.to(means.dtype) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    p = means @ W.T + t
    depth = p[:, 2]
    z = torch.where(depth > 0, depth, torch.ones_like(depth))  # behind the camera nothing counts
    margins = FOV_MARGIN * 0.5 * width / fx, FOV_MARGIN * 0.5 * height / fy
    slope_x = _clamp(p[:, 0] / z, -(cx / fx + margins[0]), (width - cx) / fx + margins[0])
    slope_y = _clamp(p[:, 1] / z, -(cy / fy + margins[1]), (height - cy) / fy + margins[1])
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * slope_x / z, zero, fy / z, -fy * slope_y / z], -1).reshape(-1, 2, 3)
    slopes = torch.zeros(len(means), 2, dtype=means.dtype)
    if gaussians.covars is not None:
        upper = gaussians.covars.triu()
        sharp2d = J @ W @ (upper + upper.triu(1).mT) @ W.mT @ J.mT
    elif quats is not None and scales is not None:
        axes = W @ reference_rotations(quats)  # columns: the Gaussian's axes in the camera frame
        M = J @ axes * scales[:, None, :]
        sharp2d = M @ M.mT
    else:
        raise InputError("are missing.", field="quats, scales", hint="give them, or covars")
    covar2d = sharp2d + eps2d * torch.eye(2, dtype=means.dtype)
    if depth_mode == "plane" and scales is not None:
        slopes = _plane_slopes(p, axes, scales, covar2d, fx.item(), fy.item()).detach()
    mean2d = torch.stack([fx * p[:, 0] / z + cx, fy * p[:, 1] / z + cy], -1)
    return ReferenceProjection(mean2d, sharp2d, covar2d, depth, slopes)


def _clamp(values: Tensor, least: Tensor, most: Tensor) -> Tensor:
    """Clamp whose bounds receive gradients."""
    return torch.where(values < least, least, torch.where(values > most, most, values))


def _plane_slopes(p: Tensor, axes: Tensor, scales: Tensor, covar2d: Tensor, fx: float, fy: float) -> Tensor:
    """Return the slopes d z / d (u, v) of the plane through p normal to the shortest axis; see project.cpp."""
    s = scales.abs()
    ordered = s.sort(-1).values
    n = torch.gather(axes, 2, s.argmin(-1)[:, None, None].expand(-1, 3, 1))[..., 0]
    fade = 1.0 - (ordered[:, 0] / ordered[:, 1].clamp_min(1e-30)) ** 2
    along = (n * p).sum(-1)
    least = 1e-6 * p[:, 2]
    factor = -fade * p[:, 2] ** 2 / torch.where(along.abs() > least, along, least)
    slope = torch.stack([factor * n[:, 0] / fx, factor * n[:, 1] / fy], -1)
    own = 4.0 * ((axes[:, 2] * s) ** 2).sum(-1)
    spread = (slope[:, None, :] @ covar2d @ slope[:, :, None])[:, 0, 0]
    return slope * torch.where(spread > own, (own / spread.clamp_min(1e-30)).sqrt(), torch.ones_like(own))[:, None]


def _pixel_centers(width: int, height: int, like: Tensor) -> Tensor:
    v, u = torch.meshgrid(torch.arange(height), torch.arange(width), indexing="ij")
    return torch.stack([u, v], -1).reshape(-1, 2).to(like.dtype) + 0.5


def _blend(
    projected: ReferenceProjection, opacities: Tensor, order: Tensor, pixels: Tensor, transmittance_min: float
) -> tuple[Tensor, Tensor, Tensor]:
    """Return the weights (M, P) of the M Gaussians of ``order``, transmittance (P,) left, margins (P,)."""
    d = pixels[None] - projected.mean2d[order][:, None]
    conic = torch.linalg.inv(projected.covar2d[order])
    sigma = 0.5 * torch.einsum("npi,nij,npj->np", d, conic, d)
    power = opacities[order][:, None] * torch.exp(-sigma)
    counts = power >= ALPHA_MIN
    alpha = torch.where(counts, power.clamp_max(ALPHA_MAX), torch.zeros_like(power))
    # Transmittance only falls, so the pixel is closed for all Gaussians behind the one that closes it.
    after = torch.cumprod(1.0 - alpha, 0)
    opened = after.detach() > transmittance_min
    alpha = torch.where(opened, alpha, torch.zeros_like(alpha))
    after_open = torch.cumprod(1.0 - alpha, 0)
    before = torch.cat([torch.ones_like(after_open[:1]), after_open[:-1]])
    left = after_open[-1] if len(order) else torch.ones(len(pixels), dtype=pixels.dtype)
    return alpha * before, left, _margins(power.detach(), after.detach(), counts, transmittance_min)


def _margins(power: Tensor, after: Tensor, counts: Tensor, transmittance_min: float) -> Tensor:
    if len(power) == 0:
        return power.new_full((power.shape[1],), torch.inf)
    jumps = torch.stack([(power / ALPHA_MIN - 1).abs(), (power / ALPHA_MAX - 1).abs()]).amin(0)
    closing = torch.where(counts, (after / max(transmittance_min, 1e-30) - 1).abs(), torch.inf)
    return torch.minimum(jumps, closing).amin(0)


def _channels(
    projected: ReferenceProjection, colors: Tensor | None, order: Tensor, pixels: Tensor, render_mode: str
) -> list[Tensor]:
    """Return the channels, each (M, 1) or (M, P)."""
    columns = [] if colors is None else [c[:, None] for c in colors[order].unbind(-1)]
    if "D" in render_mode:
        d = pixels[None] - projected.mean2d[order][:, None]
        columns.append(projected.depth[order][:, None] + (d * projected.slope[order][:, None]).sum(-1))
    return columns


def _composite(
    weights: Tensor, channels: list[Tensor], left: Tensor, background: Tensor | None, render_mode: str
) -> Tensor:
    images = [(weights * channel).sum(0) for channel in channels]
    if "ED" in render_mode:
        images[-1] = images[-1] / (1.0 - left).clamp_min(1e-10)
    if background is not None:
        images = [image + left * b for image, b in zip(images, background, strict=False)] + images[len(background) :]
    return torch.stack(images, -1)

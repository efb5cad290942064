"""Other implementations of the same model, measured in the same process as splatbot."""

from __future__ import annotations

import importlib
import importlib.util
from collections.abc import Callable
from dataclasses import dataclass

import torch
from torch import Tensor

from splatbot.bench.native import bench_native
from splatbot.bench.raster.scenes import SplatScene

TILE = 16  # [px]
ALPHA_MIN, ALPHA_MAX, TRANSMITTANCE_MIN, MAX_SIGMAS, EPS2D, FOV_MARGIN = 1.0 / 255.0, 0.99, 1e-4, 3.33, 0.3, 0.3


@dataclass(frozen=True)
class PeerRender:
    """An image (H, W, 3), opacity (H, W), and the gradients that the peer computes, by name."""

    image: Tensor
    alpha: Tensor
    gradients: dict[str, Tensor]


@dataclass(frozen=True)
class Peer:
    """One implementation. ``render`` takes scene, width, height, the image's gradient or None; it is None if absent."""

    name: str
    note: str
    render: Callable[[SplatScene, int, int, Tensor | None], PeerRender] | None


def all_peers() -> list[Peer]:
    """Return all peers, including those that cannot run here."""
    return [
        Peer(
            "torch",
            "plain torch, float32, one thread: a tile of 16x16 px at a time, dense over its Gaussians",
            torch_render,
        ),
        Peer(
            "scalar C++",
            "textbook C++, -O2, no vectors, one thread; its backward ends at the projected Gaussians",
            scalar_render,
        ),
        _gsplat(),
    ]


def _gsplat() -> Peer:
    name = "gsplat torch reference"
    if importlib.util.find_spec("gsplat") is None:
        return Peer(name, "absent: gsplat is not installed (pip install gsplat)", None)
    note = "gsplat's own projection in torch; its blending needs its CUDA extension, so tiles are blended as by torch"
    return Peer(name, note, gsplat_render)


def scalar_render(scene: SplatScene, width: int, height: int, grad: Tensor | None) -> PeerRender:
    """Render by the scalar C++ code; gradients are those of colours, opacities, projected means and conics."""
    n = len(scene)
    image, alpha = torch.empty(height, width, 3), torch.empty(height, width)
    gradients = {
        "colors": torch.zeros(n, 3),
        "opacities": torch.zeros(n),
        "means2d": torch.zeros(n, 2),
        "conics": torch.zeros(n, 3),
    }
    K = scene.intrinsics(width, height)[0]
    tensors = [t.contiguous() for t in (*scene.gaussians.values(), scene.viewmat)]
    bench_native().scalar_baseline(*tensors, K, width, height, image, alpha, grad, *gradients.values())
    return PeerRender(image, alpha, gradients if grad is not None else {})


@dataclass(frozen=True)
class Projection:
    """Centres (N, 2), inverse covariances (N, 2, 2), extents in x and y (N, 2) [px], depths (N,)."""

    mean2d: Tensor
    conic: Tensor
    radius: Tensor
    depth: Tensor


def torch_render(
    scene: SplatScene,
    width: int,
    height: int,
    grad: Tensor | None,
    project: Callable[..., Projection] | None = None,
) -> PeerRender:
    """Render by float32 operations of torch, and differentiate each tile at once, which bounds the memory."""
    leaves = [t.detach().clone().requires_grad_(grad is not None) for t in scene.gaussians.values()]
    means, quats, scales, opacities, colors = leaves
    with torch.set_grad_enabled(grad is not None):
        found = (project or _project)(scene, means, quats, scales, width, height)
    mean2d, conic, depth = found.mean2d, found.conic, found.depth
    cut = [t.detach().requires_grad_(grad is not None) for t in (mean2d, conic, opacities, colors)]
    image, alpha = torch.zeros(height, width, 3), torch.zeros(height, width)
    low, high = (mean2d.detach() - found.radius).floor(), (mean2d.detach() + found.radius).ceil()
    order = torch.argsort(depth.detach(), stable=True)
    order = order[(depth.detach() >= 0.01)[order]]
    for y in range(0, height, TILE):
        row = order[(high[order, 1] > y) & (low[order, 1] < y + TILE)]
        for x in range(0, width, TILE):
            chosen = row[(high[row, 0] > x) & (low[row, 0] < x + TILE)]
            if len(chosen):
                window = slice(y, min(y + TILE, height)), slice(x, min(x + TILE, width))
                _tile(cut, chosen, window, image, alpha, None if grad is None else grad[window])
    if grad is None:
        return PeerRender(image, alpha, {})
    torch.autograd.backward([mean2d, conic], [_grad(cut[0]), _grad(cut[1])])
    gradients = [_grad(t) for t in (means, quats, scales)] + [_grad(cut[2]), _grad(cut[3])]
    return PeerRender(image, alpha, dict(zip(scene.gaussians, gradients, strict=True)))


def gsplat_render(scene: SplatScene, width: int, height: int, grad: Tensor | None) -> PeerRender:
    """Render with the projection of gsplat's torch reference, and blend as in :func:`torch_render`."""
    return torch_render(scene, width, height, grad, _gsplat_project)


def _gsplat_project(
    scene: SplatScene, means: Tensor, quats: Tensor, scales: Tensor, width: int, height: int
) -> Projection:
    impl = importlib.import_module("gsplat.cuda._torch_impl")
    covars, _ = impl._quat_scale_to_covar_preci(quats, scales, True, False, False)
    K = scene.intrinsics(width, height)
    radii, means2d, depths, conics, _ = impl._fully_fused_projection(
        means, covars, scene.viewmat[None], K, width, height
    )
    xx, xy, yy = conics[0].unbind(-1)
    conic = torch.stack([xx, xy, xy, yy], -1).reshape(-1, 2, 2)
    return Projection(means2d[0], conic, radii[0].float(), depths[0])


def _grad(tensor: Tensor) -> Tensor:
    return torch.zeros_like(tensor) if tensor.grad is None else tensor.grad


def _project(scene: SplatScene, means: Tensor, quats: Tensor, scales: Tensor, width: int, height: int) -> Projection:
    """Project by EWA splatting (Zwicker et al. 2001)."""
    K = scene.intrinsics(width, height)[0]
    fx, fy, cx, cy = (float(v) for v in (K[0, 0], K[1, 1], K[0, 2], K[1, 2]))
    R, t = scene.viewmat[:3, :3], scene.viewmat[:3, 3]
    p = means @ R.T + t
    z = torch.where(p[:, 2] > 0.01, p[:, 2], torch.ones_like(p[:, 2]))
    mx, my = 0.5 * FOV_MARGIN * width / fx, 0.5 * FOV_MARGIN * height / fy
    tx = (p[:, 0] / z).clamp(-cx / fx - mx, (width - cx) / fx + mx)
    ty = (p[:, 1] / z).clamp(-cy / fy - my, (height - cy) / fy + my)
    zero = torch.zeros_like(z)
    J = torch.stack([fx / z, zero, -fx * tx / z, zero, fy / z, -fy * ty / z], -1).reshape(-1, 2, 3)
    w, x, y, v = torch.nn.functional.normalize(quats, dim=-1).unbind(-1)
    rows = [1 - 2 * (y * y + v * v), 2 * (x * y - w * v), 2 * (x * v + w * y)]
    rows += [2 * (x * y + w * v), 1 - 2 * (x * x + v * v), 2 * (y * v - w * x)]
    rows += [2 * (x * v - w * y), 2 * (y * v + w * x), 1 - 2 * (x * x + y * y)]
    M = J @ R @ (torch.stack(rows, -1).reshape(-1, 3, 3) * scales[:, None])
    covar = M @ M.mT + EPS2D * torch.eye(2)
    mean2d = torch.stack([fx * p[:, 0] / z + cx, fy * p[:, 1] / z + cy], -1)
    radius = torch.ceil(MAX_SIGMAS * covar.detach().diagonal(dim1=-2, dim2=-1).sqrt())
    return Projection(mean2d, torch.linalg.inv(covar), radius, p[:, 2])


def _tile(
    cut: list[Tensor], chosen: Tensor, window: tuple[slice, slice], image: Tensor, alpha: Tensor, grad: Tensor | None
) -> None:
    rows, columns = window
    v, u = torch.meshgrid(
        torch.arange(rows.start, rows.stop) + 0.5, torch.arange(columns.start, columns.stop) + 0.5, indexing="ij"
    )
    pixels = torch.stack([u, v], -1).reshape(-1, 2)
    with torch.set_grad_enabled(grad is not None):
        mean2d, conic, opacity, color = (t[chosen] for t in cut)
        d = pixels[None] - mean2d[:, None]
        sigma = 0.5 * torch.einsum("npi,nij,npj->np", d, conic, d)
        power = opacity[:, None] * torch.exp(-sigma)
        a = torch.where(power >= ALPHA_MIN, power.clamp_max(ALPHA_MAX), 0.0)
        a = torch.where(torch.cumprod(1.0 - a.detach(), 0) > TRANSMITTANCE_MIN, a, 0.0)
        after = torch.cumprod(1.0 - a, 0)
        weights = a * torch.cat([torch.ones_like(after[:1]), after[:-1]])
        out = torch.einsum("np,nc->pc", weights, color)
    if grad is not None:
        out.backward(grad.reshape(-1, 3))
    image[window] = out.detach().reshape(v.shape[0], v.shape[1], 3)
    alpha[window] = 1.0 - after[-1].detach().reshape(v.shape)

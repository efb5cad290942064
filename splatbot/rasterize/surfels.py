"""Differentiable rendering of surfels (2D Gaussian splatting) on CPUs, with gsplat's names, shapes and semantics."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize.depth_normals import depth_to_normal
from splatbot.rasterize.inputs import Inputs, check_inputs
from splatbot.rasterize.native import native
from splatbot.rasterize.options import check_choice, harmonics_degree, parse_mode
from splatbot.rasterize.scene import Gaussians, Viewpoints
from splatbot.rasterize.surfel_autograd import RasterizeSurfels, SurfelOptions
from splatbot.rasterize.surfel_meta import SurfelMeta

_MODES = ("RGB", "D", "ED", "RGB+D", "RGB+ED")


def rasterization_2dgs(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    width: int,
    height: int,
    near_plane: float = 0.01,
    far_plane: float = 1e10,
    radius_clip: float = 0.0,
    eps2d: float = 0.3,
    sh_degree: int | None = None,
    packed: bool = False,
    tile_size: int = 16,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    distloss: bool = False,
    depth_mode: Literal["expected", "median"] = "expected",
) -> tuple[Tensor, Tensor, Tensor, Tensor | None, Tensor | None, Tensor, SurfelMeta]:
    """Render N surfels, flat Gaussians, into C views; differentiable.

    The model is 2D Gaussian splatting (Huang et al. 2024). A surfel is a disc in the plane of its first two axes. A
    pixel's ray meets it (u, v) standard deviations from its centre (eq. 8-10), and its response there is
    max(exp(-(u² + v²) / 2), exp(-d²)), d pixels from the projected centre. The second term, a low-pass filter, keeps
    discs that are seen edge-on or from afar (eq. 11). Blending is that of :func:`splatbot.rasterize.rasterization`.
    Depth is that of the ray's hit with the disc, or of the centre where the low-pass filter is larger. Hits nearer than
    the near plane do not count. gsplat takes every depth at the centre.

    Args:
        means: (N, 3) [m], world frame.
        quats: (N, 4) wxyz, any norm; a zero quaternion counts as no rotation and receives no gradient.
        scales: (N, 3) standard deviations [m]; the third is ignored.
        opacities: (N,) in 0..1.
        colors: (N, D) or (C, N, D), any number of channels. With ``sh_degree``, coefficients (N, K, 3) or
            (C, N, K, 3). None in the modes D and ED.
        viewmats: (C, 4, 4) world to camera; float32 or float64.
        Ks: (C, 3, 3) [px]; float32 or float64. Its focal lengths and principal point receive gradients.
        width: of the image [px].
        height: of the image [px].
        near_plane: surfels whose centre is nearer than this are left out, and nearer hits [m].
        far_plane: surfels farther than this are left out [m].
        radius_clip: surfels whose extent is at most this are left out [px].
        eps2d: has no effect on the result (the low-pass filter is fixed); accepted for gsplat's sake.
        sh_degree: None, or the degree 0..4 of the spherical harmonics in use, K >= (degree + 1)²; the colour is
            max(0, 1/2 + their sum), as in :func:`splatbot.rasterize.rasterization`.
        packed: has no effect on the result; accepted for gsplat's sake.
        tile_size: has no effect on the result; accepted for gsplat's sake.
        backgrounds: (C, D) colours seen where transmittance is left; of no effect in the modes D and ED.
        render_mode: RGB. D: depth summed with the blend weights [m]. ED: D divided by the sum of weights. RGB+D and
            RGB+ED append the depth as the last channel.
        distloss: whether to render the distortion.
        depth_mode: the depth whose normals are ``surf_normals``: "expected" or "median".

    Returns:
        render_colors: (C, H, W, X).
        render_alphas: (C, H, W, 1).
        render_normals: (C, H, W, 3) the surfels' normals, facing the camera, world frame, blended (not of length 1).
        surf_normals: (C, H, W, 3) normals of the rendered depth, world frame; None in the mode RGB.
        render_distort: (C, H, W, 1) 2 Σᵢ wᵢ |mᵢ Σ_{j<i} wⱼ - Σ_{j<i} wⱼmⱼ| over weights w and depths m [m], front to
            back: Σᵢⱼ wᵢwⱼ|mᵢ - mⱼ| (eq. 13) where the hits are in the order of the centres. None without ``distloss``.
        render_median: (C, H, W, 1) depth of the last surfel that found more than half of the light left [m]; 0 for
            none.
        meta: means2d, radii, depths, normals, opacities, tiles_per_gauss, visible_ids and the tile grid, computed on
            access. ``gradient_2dgs`` (C, N, 2), zeros whose ``grad`` is that of the projected centres [px⁻¹], serves
            densification: call its ``retain_grad()`` before ``backward()``.

    Raises:
        InputError: a shape, type, device or option does not fit, or a value is not finite.
        NativeError: the C++ core is missing or cannot run here.
    """
    _reject_unsupported(sparse_grad, absgrad, depth_mode)
    check_choice("render_mode", render_mode, _MODES)
    _, depth = parse_mode(render_mode)
    inputs = check_inputs(
        Gaussians(means, quats, scales, opacities, colors, sh_degree=sh_degree),
        Viewpoints(viewmats, Ks, width, height, backgrounds),
        render_mode,
    )
    if inputs.layout.batch:
        raise InputError("has batch dimensions.", field="means", hint="render surfels of one scene at a time")
    options = SurfelOptions(
        width=width,
        height=height,
        near_plane=float(near_plane),
        far_plane=float(far_plane),
        radius_clip=float(radius_clip),
        sh_degree=harmonics_degree(render_mode, sh_degree),
        view_colors=inputs.layout.view_colors,
        depth=depth,
        distortion=distloss,
    )
    # The sum with a tensor that requires gradients is not a leaf, as gsplat's users expect: they call retain_grad().
    wants_grad = torch.is_grad_enabled() and any(t is not None and t.requires_grad for t in inputs.tensors())
    shift = torch.zeros(len(inputs.viewmats), len(inputs.means), 2, requires_grad=wants_grad)
    states: list[Any] = []
    images = _render(inputs, shift, options, states)
    renders, alphas, normals, median = images[:4]
    distortion = images[4] if distloss else None
    surf_normals = None
    if depth != "none":
        shown = median if depth_mode == "median" else _expected(renders[..., -1:], alphas, depth)
        surf_normals = depth_to_normal(shown, inputs.viewmats, inputs.Ks)
    meta = SurfelMeta(states, inputs.opacities.detach(), width, height, shift)
    return renders, alphas, normals, surf_normals, distortion, median, meta


def _render(inputs: Inputs, shift: Tensor, options: SurfelOptions, states: list[Any]) -> tuple[Tensor, ...]:
    """Render all channels: the first with everything else, further ones for their colours alone."""
    most = native().MAX_SURFEL_CHANNELS
    channels = inputs.colors.shape[-1]
    geometry = (inputs.means, inputs.quats, inputs.scales, inputs.opacities)

    def part(first: int, options: SurfelOptions, states: list[Any]) -> tuple[Tensor, ...]:
        colors = inputs.colors[..., first : first + most].contiguous()
        behind = None if inputs.backgrounds is None else inputs.backgrounds[:, first : first + most].contiguous()
        tensors = (*geometry, colors, inputs.viewmats, inputs.Ks, behind, shift)
        images: tuple[Tensor, ...] = RasterizeSurfels.apply(*tensors, options, states)
        return images

    images = part(0, options, states)
    if channels <= most:
        return images
    further = [part(first, options.colors_only(), []) for first in range(most, channels, most)]
    columns = [images[0][..., :most], *(rest[0] for rest in further), images[0][..., most:]]
    return torch.cat(columns, -1), *images[1:]


def _expected(depth: Tensor, alphas: Tensor, kind: str) -> Tensor:
    return depth if kind == "expected" else depth / alphas.clamp_min(1e-10)


def _reject_unsupported(sparse_grad: bool, absgrad: bool, depth_mode: str) -> None:
    """Refuse an option that would change the result instead of ignoring it."""
    for name, value in (("sparse_grad", sparse_grad), ("absgrad", absgrad)):
        if value:
            raise InputError("is not supported for surfels.", field=name, hint="leave it out")
    check_choice("depth_mode", depth_mode, ("expected", "median"))

"""Differentiable rendering of 3D Gaussians on CPUs, with gsplat's names, shapes and blend semantics."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.gaussians.harmonics import sh_to_rgb
from splatbot.rasterize.cameras import CameraModel, CameraSettings, RollingShutterType, lenses_of
from splatbot.rasterize.inputs import check_inputs
from splatbot.rasterize.meta import RenderMeta
from splatbot.rasterize.native import native

DepthMode = Literal["center", "plane"]


@dataclass(frozen=True)
class _Options:
    """What a render is told besides tensors."""

    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    eps2d: float
    depth: str
    plane_depth: bool
    lenses: list[Any] | None = None


def rasterization(
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
    tile_size: int | None = None,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    camera_model: CameraModel = "pinhole",
    covars: Tensor | None = None,
    *,
    depth_mode: DepthMode = "center",
    with_ut: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    rolling_shutter: RollingShutterType | str = RollingShutterType.GLOBAL,
    viewmats_rs: Tensor | None = None,
    ut_params: Any = None,
    **unsupported: Any,
) -> tuple[Tensor, Tensor, RenderMeta]:
    """Render N Gaussians into C views; differentiable.

    The model is 3D Gaussian splatting (Kerbl et al. 2023; projection: Zwicker et al. 2001) with gsplat's constants.
    Pixel (i, j) is sampled at (i + 0.5, j + 0.5): use ``Camera.K_corner``. A Gaussian of opacity o has
    alpha = min(0.99, o exp(-σ)) at a pixel, counts from 1/255 on, and closes the pixel, without counting, if it would
    bring the transmittance to 1e-4 or below; the gradient is zero where alpha is capped. Gaussians are blended in
    order of depth, equal depths in order of index. The result is the same, bit for bit, in every run and for any
    number of threads.

    Args:
        means: (N, 3) [m], world frame.
        quats: (N, 4) wxyz, any norm; a zero quaternion counts as no rotation and receives no gradient.
        scales: (N, 3) standard deviations [m].
        opacities: (N,) in 0..1.
        colors: (N, D) or (C, N, D), any number of channels; with ``sh_degree=0`` (N, 1, 3) DC coefficients; None in
            the modes D and ED.
        viewmats: (C, 4, 4) world to camera; float32 or float64.
        Ks: (C, 3, 3) [px]; float32 or float64. Receives no gradient.
        width: of the image [px].
        height: of the image [px].
        near_plane: Gaussians nearer than this are left out [m].
        far_plane: Gaussians farther than this are left out [m].
        radius_clip: Gaussians whose extent is at most this are left out [px].
        eps2d: added to the diagonal of each projected covariance [px²].
        sh_degree: None, or 0.
        packed: has no effect on the result; accepted for gsplat's sake.
        tile_size: has no effect on the result; accepted for gsplat's sake.
        backgrounds: (C, D) colours seen where transmittance is left; of no effect in the modes D and ED.
        render_mode: RGB; D: depth summed with the blend weights [m]; ED: that, divided by the sum of weights; RGB+D
            and RGB+ED append it as the last channel.
        rasterize_mode: "classic".
        camera_model: "pinhole"; "ortho": u = fx x + cx, with fx, fy in [px/m]; "fisheye": equidistant, a point's
            distance from the principal point is f times its angle from the axis. Each is linearized at the Gaussian's
            centre (EWA), the slopes of the pinhole clamped 0.3 half-images beyond the edge. In all of them depth is
            z, and what is nearer than ``near_plane`` or behind the camera is not seen.
        channel_chunk: has no effect on the result; accepted for gsplat's sake.
        depth_mode: "center" gives a Gaussian one depth, that of its centre (gsplat); "plane" lets it vary over the
            footprint as that of the plane through the centre and normal to the Gaussian's shortest axis, faded out as
            the shortest axis nears the middle one and bounded where the plane is seen edge-on. Its gradient takes
            the plane's slopes as constants: a loss on depth moves Gaussians, it does not turn them. "plane" is for
            the linearized pinhole.
        with_ut: project by the unscented transform (Wu et al. 2024, 3DGUT): exact at seven sigma points, so that
            distortion and rolling shutter are possible; slower. What is drawn is still an ellipse. A Gaussian of
            which a sigma point is nearer to a pinhole than ``near_plane``, or where the distortion no longer grows, is left out.
        radial_coeffs: OpenCV's (C, 6) k1..k6 of a pinhole or (C, 4) k1..k4 of a fisheye; needs ``with_ut``, as do:
        tangential_coeffs: (C, 2) p1, p2 of a pinhole.
        thin_prism_coeffs: (C, 4) s1..s4 of a pinhole.
        rolling_shutter: order in which lines are read; the poses are then ``viewmats`` at the first line's centre and
            ``viewmats_rs`` at the last's, in between rotation turns evenly and translation is linear. A point is seen
            at the time its own, unrounded, line is read (gsplat rounds the line down). Depth is that half-way.
            Poses receive no gradient and are refused if they ask for one.
        viewmats_rs: (C, 4, 4), see there.
        ut_params: spread of the sigma points, see :class:`UnscentedTransformParameters`.

    Returns:
        render_colors (C, H, W, X), render_alphas (C, H, W, 1), meta: means2d, depths, conics, radii, opacities,
        tiles_per_gauss, visible_ids and the tile grid, computed when asked for.

    Raises:
        InputError: a shape, type, device or option does not fit, or a value is not finite.
        NativeError: the C++ core is missing or cannot run here.
    """
    _reject_unsupported(rasterize_mode, covars, sparse_grad, absgrad, depth_mode, unsupported)
    if sh_degree is not None:
        colors = _from_harmonics(colors, sh_degree)
    wants_color, depth = _parse_mode(render_mode)
    if not wants_color:
        colors, backgrounds = None, None
    elif colors is None:
        raise InputError(f"is missing for {render_mode}.", field="colors", hint="give colours, or render_mode='D'")
    inputs = check_inputs(means, quats, scales, opacities, colors, viewmats, Ks, backgrounds, width, height)
    settings = CameraSettings(
        camera_model,
        with_ut,
        radial_coeffs,
        tangential_coeffs,
        thin_prism_coeffs,
        rolling_shutter,
        viewmats_rs,
        ut_params,
    )
    lenses, poses = lenses_of(settings, inputs.viewmats, float(near_plane))
    if lenses is not None and depth_mode == "plane":
        raise InputError("'plane' needs a linearized pinhole.", field="depth_mode", hint="use 'center'")
    inputs = replace(inputs, viewmats=poses)
    options = _Options(
        width=width,
        height=height,
        near_plane=float(near_plane),
        far_plane=float(far_plane),
        radius_clip=float(radius_clip),
        eps2d=float(eps2d),
        depth=depth,
        plane_depth=depth_mode == "plane" and depth != "none",
        lenses=lenses,
    )
    states: list[Any] = []
    renders, alphas = _Rasterize.apply(*inputs.tensors(), inputs.Ks, options, states)
    return renders, alphas, RenderMeta(states, inputs.opacities.detach(), width, height)


class _Rasterize(torch.autograd.Function):
    """The native passes, one view after the other."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        viewmats: Tensor,
        backgrounds: Tensor | None,
        Ks: Tensor,
        options: _Options,
        states: list[Any],
    ) -> tuple[Tensor, Tensor]:
        n_views, depth_channels = len(viewmats), int(options.depth != "none")
        size = (n_views, options.height, options.width)
        renders = torch.empty((*size, colors.shape[-1] + depth_channels), dtype=torch.float32)
        alphas = torch.empty((*size, 1), dtype=torch.float32)
        geometry = [t.detach() for t in (means, quats, scales, opacities)]
        viewmats64 = viewmats.detach().to(torch.float64).contiguous()
        for i in range(n_views):
            state = native().rasterize_forward(
                *geometry,
                _of_view(colors, i),
                viewmats64[i],
                Ks[i],
                options.width,
                options.height,
                options.near_plane,
                options.far_plane,
                options.radius_clip,
                options.eps2d,
                options.depth,
                options.plane_depth,
                None if backgrounds is None else backgrounds[i].detach(),
                renders[i],
                alphas[i, ..., 0],
                None if options.lenses is None else options.lenses[i],
            )
            if isinstance(state, tuple):
                field, row = state
                raise InputError(f"row {row} is not finite.", field=field, hint="find where the NaN or Inf comes from")
            states.append(state)
        ctx.states = tuple(states)
        ctx.save_for_backward(means, quats, scales, opacities, colors, viewmats, backgrounds)
        ctx.set_materialize_grads(False)
        return renders, alphas

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        grad_renders, grad_alphas = grads
        means, quats, scales, opacities, colors, viewmats, backgrounds = ctx.saved_tensors
        need = ctx.needs_input_grad
        geometry = [t.detach() for t in (means, quats, scales, opacities)]
        out = [torch.empty_like(t) if n else None for t, n in zip(geometry, need[:4], strict=True)]
        # Zeros only where the second view adds to rows that the first did not write.
        new_colors = torch.empty if colors.ndim == 2 or len(ctx.states) == 1 else torch.zeros
        grad_colors = new_colors(colors.shape, dtype=torch.float32) if need[4] else None
        grad_viewmats = torch.zeros(viewmats.shape, dtype=torch.float64) if need[5] else None
        grad_backgrounds = torch.zeros(backgrounds.shape, dtype=torch.float64) if need[6] else None
        if grad_renders is None and grad_alphas is None:
            return (None,) * 10
        for i, state in enumerate(ctx.states):
            pose = torch.zeros(12, dtype=torch.float64) if grad_viewmats is not None else None
            native().rasterize_backward(
                state,
                *geometry,
                _of_view(colors, i),
                None if backgrounds is None else backgrounds[i].detach(),
                None if grad_renders is None else grad_renders[i].contiguous(),
                None if grad_alphas is None else grad_alphas[i, ..., 0].contiguous(),
                *out,
                None if grad_colors is None else _of_view(grad_colors, i),
                pose,
                None if grad_backgrounds is None else grad_backgrounds[i],
                i > 0,
            )
            if grad_viewmats is not None and pose is not None:
                grad_viewmats[i, :3, :3] = pose[:9].view(3, 3)
                grad_viewmats[i, :3, 3] = pose[9:]
        grad_viewmats = None if grad_viewmats is None else grad_viewmats.to(viewmats.dtype)
        grad_backgrounds = None if grad_backgrounds is None else grad_backgrounds.to(torch.float32)
        return (*out, grad_colors, grad_viewmats, grad_backgrounds, None, None, None)


def _of_view(colors: Tensor, i: int) -> Tensor:
    return (colors if colors.ndim == 2 else colors[i]).detach()


def _from_harmonics(colors: Tensor | None, sh_degree: int) -> Tensor:
    if sh_degree != 0:
        raise InputError(f"is {sh_degree}.", field="sh_degree", hint="pass colours, or coefficients with sh_degree=0")
    if colors is None or colors.ndim != 3 or colors.shape[1] < 1 or colors.shape[2] != 3:
        shape = None if colors is None else tuple(colors.shape)
        raise InputError(f"is {shape}.", field="colors", hint="with sh_degree give coefficients (N, K, 3)")
    return sh_to_rgb(colors[:, 0]).clamp_min(0.0)


def _parse_mode(render_mode: str) -> tuple[bool, str]:
    """Whether colours are rendered, and what of depth."""
    modes = {
        "RGB": (True, "none"),
        "D": (False, "accumulated"),
        "ED": (False, "expected"),
        "RGB+D": (True, "accumulated"),
        "RGB+ED": (True, "expected"),
    }
    if render_mode not in modes:
        raise InputError(f"is {render_mode!r}.", field="render_mode", hint=f"one of {', '.join(modes)}")
    return modes[render_mode]


def _reject_unsupported(
    rasterize_mode: str,
    covars: Tensor | None,
    sparse_grad: bool,
    absgrad: bool,
    depth_mode: str,
    unsupported: dict[str, Any],
) -> None:
    """An option that would change the result is refused, never ignored."""
    choices: Sequence[tuple[str, Any, tuple[Any, ...]]] = (
        ("rasterize_mode", rasterize_mode, ("classic",)),
        ("sparse_grad", sparse_grad, (False,)),
        ("absgrad", absgrad, (False,)),
        ("depth_mode", depth_mode, ("center", "plane")),
    )
    for name, value, known in choices:
        if value not in known:
            names = ", ".join(repr(k) for k in known)
            raise InputError(f"{value!r} is not supported.", field=name, hint=f"use {names}")
    if covars is not None:
        raise InputError("is not supported.", field="covars", hint="give quats and scales")
    for name, value in unsupported.items():
        if value is not None and value is not False:
            raise InputError("is not supported.", field=name, hint="leave it out")

"""Differentiable rendering of 3D Gaussians on CPUs, with gsplat's names, shapes and blend semantics."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, Literal

import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize.autograd import attach
from splatbot.rasterize.cameras import (
    CameraModel,
    CameraSettings,
    RollingShutterType,
    UnscentedTransformParameters,
    cameras_of,
)
from splatbot.rasterize.centers import Centers
from splatbot.rasterize.gsplat_backend import rasterization_gsplat
from splatbot.rasterize.inputs import Inputs, check_inputs
from splatbot.rasterize.median import median_depth, median_ids
from splatbot.rasterize.meta import RenderMeta
from splatbot.rasterize.normals import facing_axes
from splatbot.rasterize.options import (
    DEFAULT_TILE_SIZE,
    TRANSMITTANCE_MIN,
    RasterOptions,
    check_choice,
    harmonics_degree,
    parse_mode,
    refuse_absent,
)
from splatbot.rasterize.passes import run_forward
from splatbot.rasterize.scene import Gaussians, Viewpoints

DepthMode = Literal["center", "plane"]


def rasterization(
    means: Tensor,
    quats: Tensor | None,
    scales: Tensor | None,
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
    packed: bool = True,
    tile_size: int | None = None,
    backgrounds: Tensor | None = None,
    render_mode: str = "RGB",
    sparse_grad: bool = False,
    absgrad: bool = False,
    rasterize_mode: Literal["classic", "antialiased"] = "classic",
    channel_chunk: int = 32,
    distributed: bool = False,
    camera_model: CameraModel = "pinhole",
    segmented: bool = False,
    covars: Tensor | None = None,
    *,
    masks: Tensor | None = None,
    depth_mode: DepthMode = "center",
    transmittance_min: float = TRANSMITTANCE_MIN,
    with_ut: bool = False,
    radial_coeffs: Tensor | None = None,
    tangential_coeffs: Tensor | None = None,
    thin_prism_coeffs: Tensor | None = None,
    rolling_shutter: RollingShutterType | str | None = None,
    viewmats_rs: Tensor | None = None,
    ut_params: UnscentedTransformParameters | None = None,
    return_normals: bool = False,
    backend: Literal["native", "gsplat"] = "native",
    **absent: Any,
) -> tuple[Tensor, Tensor, RenderMeta]:
    """Render N Gaussians into C views; differentiable.

    The model is 3D Gaussian splatting (Kerbl et al. 2023; projection: Zwicker et al. 2001) with gsplat's constants.
    Pixel (i, j) is sampled at (i + 0.5, j + 0.5): use ``Camera.K_corner``. A Gaussian of opacity o has
    alpha = min(0.99, o exp(-σ)) at a pixel and contributes from 1/255 on. If it would bring the transmittance to 1e-4
    or below, it closes the pixel without contributing. The gradient is zero where alpha is capped. Gaussians are
    blended in order of depth, equal depths in order of index. The result is the same, bit for bit, in every run and for
    any number of threads.

    Dimensions "..." are leading batch dimensions, the same for all arguments: scenes rendered one after the other.

    Args:
        means: (..., N, 3) [m], world frame.
        quats: (..., N, 4) wxyz, any norm; a zero quaternion counts as no rotation and receives no gradient.
        scales: (..., N, 3) standard deviations [m].
        opacities: (..., N) in 0..1.
        colors: (..., N, D) or (..., C, N, D), any number of channels. With ``sh_degree``, coefficients
            (..., N, K, 3) or (..., C, N, K, 3). None in the modes D and ED.
        viewmats: (..., C, 4, 4) world to camera; float32 or float64.
        Ks: (..., C, 3, 3) [px]; float32 or float64. fx, fy, cx and cy receive gradients.
        width: of the image [px].
        height: of the image [px].
        near_plane: Gaussians nearer than this are left out [m].
        far_plane: Gaussians farther than this are left out [m].
        radius_clip: Gaussians whose extent is at most this are left out [px].
        eps2d: added to the diagonal of each projected covariance [px²].
        sh_degree: None, or the degree 0..4 of the spherical harmonics in use, K >= (degree + 1)². The colour is
            max(0, 1/2 + their sum) with 3DGS's signs, computed for the Gaussians in view alone.
        packed: the layout of meta: rows of the Gaussians in view, or one row for every Gaussian and view. The images
            are the same.
        tile_size: side of the square tiles of ``masks`` and meta [px], 16 by default; no effect on the images.
        backgrounds: (..., C, D) colours seen where transmittance is left; of no effect in the modes D and ED.
        render_mode: RGB. D: depth summed with the blend weights [m]. ED: D divided by the sum of weights. RGB+D and
            RGB+ED append the depth as the last channel. MD, RGB+MD: median depth, that of the centre of the Gaussian at
            which transmittance falls to 1/2 or below, or 0. Its gradient goes to the depth of that Gaussian.
        sparse_grad: gradients to means, quats, scales and covars as sparse COO tensors of the rows in view; packed
            and without batch dimensions only.
        absgrad: ``meta["means2d"].absgrad`` after backward: the sums over pixels of the absolute values of the
            centres' gradients through alpha (Ye et al. 2024). Each group of 8 channels is summed separately.
        rasterize_mode: "classic"; "antialiased" multiplies opacities by √max(det Σ / det(Σ + eps2d I), 0.005²) of the
            projected covariance Σ (Yu et al. 2024).
        channel_chunk: has no effect on the result; accepted for gsplat's sake.
        distributed: False.
        camera_model: "pinhole". "ortho": u = fx x + cx, with fx, fy in [px/m]. "fisheye": equidistant, the distance
            from the principal point is f times the angle from the axis. Each is linearized at the Gaussian's
            centre (EWA); the pinhole's slopes are clamped 0.3 half-images beyond the edge. In all of them depth is
            z, and Gaussians nearer than ``near_plane`` or behind the camera are left out.
        segmented: has no effect on the result; accepted for gsplat's sake.
        covars: (..., N, 3, 3) [m²] in place of quats and scales; the upper triangle counts, and receives the gradient.
        masks: (..., C, tile_height, tile_width) bool; tiles that are False show the background alone and give no
            gradient to Gaussians.
        depth_mode: "center" gives a Gaussian one depth, that of its centre (gsplat). "plane" lets it vary over the
            footprint as the depth of the plane through the centre, normal to the Gaussian's shortest axis. The slope
            fades out as the shortest axis nears the middle one, and is bounded where the plane is seen edge-on. Its
            gradient takes the plane's slopes as constants: a loss on depth moves Gaussians, it does not turn them.
            "plane" is for the linearized pinhole, and not for median depth.
        transmittance_min: a pixel is closed before its transmittance falls to this, [0, 0.5): accuracy for time.
            gsplat's is 1e-4.
        with_ut: project by the unscented transform (Wu et al. 2024, 3DGUT): exact at seven sigma points, so that
            distortion and rolling shutter are possible; slower. The footprint is still an ellipse: ``with_eval3d`` is
            refused. Needs quats and scales. A Gaussian of which a sigma point is nearer to a pinhole than
            ``near_plane``, or where the distortion no longer grows, is left out.
        radial_coeffs: OpenCV's (..., C, 6) k1..k6 of a pinhole or (..., C, 4) k1..k4 of a fisheye; needs ``with_ut``,
            as do all that follow.
        tangential_coeffs: (..., C, 2) p1, p2 of a pinhole.
        thin_prism_coeffs: (..., C, 4) s1..s4 of a pinhole.
        rolling_shutter: order in which lines are read. The poses are ``viewmats`` at the first line's centre and
            ``viewmats_rs`` at the last one's. Rotation and translation are interpolated linearly in between. A point is
            seen when its own, unrounded, line is read (gsplat rounds the line down). Depth is that half-way.
        viewmats_rs: (..., C, 4, 4), see there.
        ut_params: spread of the sigma points.
        return_normals: ``meta["normals"]`` (..., C, H, W, 3): the Gaussians' shortest axes, unit vectors in the world
            frame turned towards the camera, summed with the blend weights. Their gradient reaches quats and, through
            the weights, all else. A pass of its own.
        backend: "gsplat" hands the call to gsplat.rasterization, for tensors on a CUDA device.
        absent: gsplat's other options, as long as they have no effect.

    Returns:
        render_colors (..., C, H, W, X), render_alphas (..., C, H, W, 1), meta (see :class:`RenderMeta`), computed
        on access.

    Raises:
        InputError: a shape, type, device or option does not fit, or a value is not finite.
        NativeError: the C++ core is missing or cannot run here.
    """
    arguments = dict(locals())
    if backend == "gsplat":
        return _to_gsplat(arguments)
    check_choice("backend", backend, ("native", "gsplat"))
    options = _check_options(arguments)
    inputs = check_inputs(
        Gaussians(means, quats, scales, opacities, colors, covars, sh_degree),
        Viewpoints(viewmats, Ks, width, height, backgrounds),
        render_mode,
        masks=masks,
        tile_size=options.tile_size,
    )
    if options.sparse_grad and inputs.layout.batch:
        raise InputError(
            "is set together with batch dimensions.", field="sparse_grad", hint="render one scene at a time"
        )
    settings = CameraSettings(camera_model, *(arguments[name] for name in _CAMERA))
    cameras = cameras_of(settings, inputs.viewmats, options.near_plane)
    _check_camera_goes_with(settings, covars, depth_mode)
    inputs, options = (
        replace(inputs, viewmats=cameras.viewmats, motion=cameras.motion),
        replace(options, lenses=cameras.lenses),
    )
    renders, alphas, meta = _render(inputs, options)
    if render_mode.endswith("MD"):
        wants_color, _ = parse_mode(render_mode)
        renders = _with_median(inputs, options, renders if wants_color else None, meta)
    if return_normals:
        meta["normals"] = _render_normals(inputs, options, parallel=camera_model == "ortho")
    return renders, alphas, meta


# Arguments of CameraSettings after the model, with the values that have no effect.
_CAMERA = {
    "with_ut": False,
    "radial_coeffs": None,
    "tangential_coeffs": None,
    "thin_prism_coeffs": None,
    "rolling_shutter": None,
    "viewmats_rs": None,
    "ut_params": None,
}


def _check_camera_goes_with(settings: CameraSettings, covars: Tensor | None, depth_mode: str) -> None:
    if not settings.plain and depth_mode == "plane":
        raise InputError("'plane' needs a linearized pinhole.", field="depth_mode", hint="use 'center'")
    if settings.with_ut and covars is not None:
        raise InputError("have no axes for the unscented transform.", field="covars", hint="give quats and scales")


def _with_median(inputs: Inputs, options: RasterOptions, colors: Tensor | None, meta: RenderMeta) -> Tensor:
    layout = inputs.layout
    ids = median_ids(meta.states, options.height, options.width)
    means = inputs.means.reshape(layout.n_batches, layout.n_gaussians, 3)
    depth = median_depth(ids, means, inputs.viewmats.reshape(-1, 4, 4)).reshape(*layout.views, *ids.shape[1:], 1)
    meta["median_ids"] = ids.reshape(*layout.views, *ids.shape[1:])
    return depth if colors is None else torch.cat([colors, depth], -1)


def _render_normals(inputs: Inputs, options: RasterOptions, *, parallel: bool) -> Tensor:
    if inputs.quats is None or inputs.scales is None:
        raise InputError("have no axes to be normals.", field="covars", hint="give quats and scales")
    layout = inputs.layout
    parts = (inputs.means, inputs.quats, inputs.scales, inputs.viewmats)
    scenes = [facing_axes(*(layout.scene(t, b) for t in parts), parallel=parallel) for b in range(layout.n_batches)]
    normals = torch.stack(scenes) if layout.batch else scenes[0]
    inputs = replace(inputs, colors=normals, backgrounds=None, layout=replace(layout, view_colors=True))
    options = replace(options, sh_degree=-1, depth="none", plane_depth=False, absgrad=False)
    return _render(inputs, options)[0]


def _render(inputs: Inputs, options: RasterOptions) -> tuple[Tensor, Tensor, RenderMeta]:
    layout = inputs.layout
    rendered = run_forward(inputs, options)
    centers = Centers(
        layout, rendered.states if options.packed else None, absgrad=options.absgrad, pinhole=options.lenses is None
    )
    means2d = centers.new_tensor(inputs)
    renders, alphas = attach(inputs, options, rendered, centers, means2d)
    if layout.batch:
        renders, alphas = (t.reshape(*layout.batch, *t.shape[1:]) for t in (renders, alphas))
    meta = RenderMeta(rendered.states, layout, options, inputs.opacities.detach(), centers, means2d)
    return renders, alphas, meta


def _check_options(given: dict[str, Any]) -> RasterOptions:
    """Refuse an option that would change the result instead of ignoring it."""
    refuse_absent({**given["absent"], "distributed": given["distributed"]})
    check_choice("rasterize_mode", given["rasterize_mode"], ("classic", "antialiased"))
    check_choice("depth_mode", given["depth_mode"], ("center", "plane"))
    if given["sparse_grad"] and not given["packed"]:
        raise InputError("needs packed=True.", field="sparse_grad", hint="set packed, or leave sparse_grad out")
    if given["covars"] is not None and given["depth_mode"] == "plane":
        raise InputError("is set together with depth_mode='plane'.", field="covars", hint="give quats and scales")
    if given["render_mode"].endswith("MD") and given["depth_mode"] == "plane":
        raise InputError("'plane' is not for median depth.", field="depth_mode", hint="use 'center'")
    _, depth = parse_mode(given["render_mode"])
    return RasterOptions(
        width=given["width"],
        height=given["height"],
        near_plane=float(given["near_plane"]),
        far_plane=float(given["far_plane"]),
        radius_clip=float(given["radius_clip"]),
        eps2d=float(given["eps2d"]),
        sh_degree=harmonics_degree(given["render_mode"], given["sh_degree"]),
        depth=depth,
        plane_depth=given["depth_mode"] == "plane" and depth != "none",
        antialiased=given["rasterize_mode"] == "antialiased",
        transmittance_min=_check_transmittance(given["transmittance_min"]),
        packed=bool(given["packed"]),
        tile_size=DEFAULT_TILE_SIZE if given["tile_size"] is None else given["tile_size"],
        sparse_grad=bool(given["sparse_grad"]),
        absgrad=bool(given["absgrad"]),
    )


def _check_transmittance(value: float) -> float:
    if not 0.0 <= value < 0.5:
        raise InputError(f"is {value}.", field="transmittance_min", hint="give a share in [0, 0.5)")
    return float(value)


def _to_gsplat(given: dict[str, Any]) -> tuple[Tensor, Tensor, Any]:
    """Call gsplat with the same arguments; refuse the options that it does not have."""
    check_choice("depth_mode", given.pop("depth_mode"), ("center",))
    if given.pop("transmittance_min") != TRANSMITTANCE_MIN:
        raise InputError("is fixed in gsplat.", field="transmittance_min", hint="use backend='native'")
    if given.pop("masks") is not None:
        raise InputError("is not known to gsplat.", field="masks", hint="use backend='native'")
    for name, nothing in {**_CAMERA, "return_normals": False}.items():
        if given[name] is None or given[name] is nothing:
            del given[name]  # gsplat's own default has no effect either
    del given["backend"]
    absent = given.pop("absent")
    return rasterization_gsplat(**given, **absent)

"""The native passes over all views of a render, without autograd."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize.inputs import Inputs
from splatbot.rasterize.native import native
from splatbot.rasterize.options import RasterOptions

_GEOMETRY = 5  # number of leading inputs: means, quats, scales, covars, opacities


@dataclass(frozen=True)
class Rendered:
    """Images of all views, (B, C, H, W, X) or (C, H, W, X), and the state of each view's pass."""

    renders: Tensor
    alphas: Tensor
    states: tuple[Any, ...]  # of view c of scene b at b C + c


@dataclass
class Wanted:
    """Which gradients a backward pass is to find."""

    inputs: tuple[bool, ...]  # in the order of Inputs.tensors()
    means2d: bool
    absolute2d: bool


def _geometry(inputs: Inputs, b: int) -> list[Tensor | None]:
    return [None if t is None else inputs.layout.scene(t, b) for t in inputs.tensors()[:_GEOMETRY]]


def run_forward(inputs: Inputs, options: RasterOptions) -> Rendered:
    """Render every view.

    Raises:
        InputError: a value is not finite, or a camera cannot be inverted.
    """
    inputs, layout = inputs.detached(), inputs.layout
    lead = (layout.n_batches, layout.n_cameras) if layout.batch else (layout.n_cameras,)
    channels = inputs.colors.shape[-1] + int(options.depth != "none")
    renders = torch.empty((*lead, options.height, options.width, channels), dtype=torch.float32)
    alphas = torch.empty((*lead, options.height, options.width, 1), dtype=torch.float32)
    viewmats, Ks = (t.to(torch.float64) for t in (inputs.viewmats, inputs.Ks))
    states = []
    for b in range(layout.n_batches):
        geometry = _geometry(inputs, b)
        for c in range(layout.n_cameras):
            state = native().rasterize_forward(
                *geometry,
                layout.colors_of(inputs.colors, b, c),
                options.sh_degree,
                layout.view(viewmats, b, c),
                layout.view(Ks, b, c),
                options.width,
                options.height,
                options.near_plane,
                options.far_plane,
                options.radius_clip,
                options.eps2d,
                options.depth,
                options.plane_depth,
                options.antialiased,
                options.transmittance_min,
                None if inputs.backgrounds is None else layout.view(inputs.backgrounds, b, c),
                None if inputs.masks is None else layout.view(inputs.masks, b, c),
                options.tile_size,
                layout.view(renders, b, c),
                layout.view(alphas, b, c)[..., 0],
                None if options.lenses is None else options.lenses[b * layout.n_cameras + c],
            )
            if isinstance(state, tuple):
                field, row = state
                where = f"row {row}" if not layout.batch else f"row {row} of scene {b}"
                raise InputError(f"{where} is not finite.", field=field, hint="find where the NaN or Inf comes from")
            states.append(state)
    return Rendered(renders, alphas, tuple(states))


@dataclass
class Gradients:
    """Gradients to the inputs, in the order of Inputs.tensors(); None where none was wanted."""

    inputs: list[Tensor | None]
    means2d: Tensor | None  # (views, N, 2)
    absolute2d: Tensor | None  # (views, N, 2)


def run_backward(
    inputs: Inputs,
    options: RasterOptions,
    states: tuple[Any, ...],
    grad_renders: Tensor | None,
    grad_alphas: Tensor | None,
    wanted: Wanted,
) -> Gradients:
    """Compute the gradients of a loss from its gradients to the images."""
    layout = inputs.layout
    shape = [None if t is None or not w else t for t, w in zip(inputs.tensors(), wanted.inputs, strict=True)]
    geometry_grads = [None if t is None else torch.empty_like(t, dtype=torch.float32) for t in shape[:_GEOMETRY]]
    # Zeros only where a view adds to rows that no view wrote.
    fresh = torch.zeros if layout.view_colors and layout.n_cameras > 1 else torch.empty
    colors = None if shape[5] is None else fresh(inputs.colors.shape, dtype=torch.float32)
    wants_camera = shape[6] is not None or shape[7] is not None or shape[9] is not None
    views = len(states)
    camera = torch.zeros(views, native().CAMERA_SUMS, dtype=torch.float64) if wants_camera else None
    channels = 3 if options.sh_degree >= 0 else inputs.colors.shape[-1]
    backgrounds = None if shape[8] is None else torch.zeros(views, channels, dtype=torch.float64)
    n = layout.n_gaussians
    means2d = torch.empty(views, n, 2) if wanted.means2d else None
    absolute2d = torch.empty(views, n, 2) if wanted.absolute2d else None
    for b in range(layout.n_batches):
        geometry = _geometry(inputs, b)
        outputs = [None if t is None else layout.scene(t, b) for t in geometry_grads]
        for c in range(layout.n_cameras):
            at = b * layout.n_cameras + c
            native().rasterize_backward(
                states[at],
                *geometry,
                layout.colors_of(inputs.colors, b, c),
                options.sh_degree,
                None if inputs.backgrounds is None else layout.view(inputs.backgrounds, b, c),
                None if grad_renders is None else layout.view(grad_renders, b, c).contiguous(),
                None if grad_alphas is None else layout.view(grad_alphas, b, c)[..., 0].contiguous(),
                *outputs,
                None if colors is None else layout.colors_of(colors, b, c),
                None if camera is None else camera[at],
                None if backgrounds is None else backgrounds[at],
                None if means2d is None else means2d[at],
                None if absolute2d is None else absolute2d[at],
                c > 0,
            )
    camera_grads = camera_gradients(camera, shape[6], shape[7])
    if backgrounds is not None and inputs.backgrounds is not None:
        backgrounds = backgrounds.to(torch.float32).reshape(inputs.backgrounds.shape)
    motion = None if camera is None or shape[9] is None else camera[:, 16:].reshape(shape[9].shape)
    return Gradients([*geometry_grads, colors, *camera_grads, backgrounds, motion], means2d, absolute2d)


def camera_gradients(
    camera: Tensor | None, viewmats: Tensor | None, Ks: Tensor | None
) -> tuple[Tensor | None, Tensor | None]:
    """Compute the gradients to viewmats and Ks in their shapes and types; None for None.

    Args:
        camera: (views, CAMERA_SUMS), as the kernels sum it: rotation, translation, fx, fy, cx, cy, motion.
    """
    grad_viewmats = grad_Ks = None
    if camera is not None and viewmats is not None:
        grad_viewmats = torch.zeros(len(camera), 4, 4, dtype=torch.float64)
        grad_viewmats[:, :3, :3] = camera[:, :9].view(-1, 3, 3)
        grad_viewmats[:, :3, 3] = camera[:, 9:12]
        grad_viewmats = grad_viewmats.to(viewmats.dtype).reshape(viewmats.shape)
    if camera is not None and Ks is not None:
        grad_Ks = torch.zeros(len(camera), 3, 3, dtype=torch.float64)
        grad_Ks[:, 0, 0], grad_Ks[:, 1, 1], grad_Ks[:, 0, 2], grad_Ks[:, 1, 2] = camera[:, 12:16].unbind(-1)
        grad_Ks = grad_Ks.to(Ks.dtype).reshape(Ks.shape)
    return grad_viewmats, grad_Ks

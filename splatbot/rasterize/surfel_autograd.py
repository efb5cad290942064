"""The native passes of the surfel rasterizer as one differentiable function."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Any

import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize.native import native
from splatbot.rasterize.passes import camera_gradients


@dataclass(frozen=True)
class SurfelOptions:
    """Options of a render in addition to tensors."""

    width: int
    height: int
    near_plane: float
    far_plane: float
    radius_clip: float
    sh_degree: int  # -1: colours are colours
    view_colors: bool  # colours differ from view to view
    depth: str
    distortion: bool

    def colors_only(self) -> SurfelOptions:
        """Return the same render without depth and distortion."""
        return replace(self, depth="none", distortion=False)

    def colors_of(self, colors: Tensor, i: int) -> Tensor:
        """Return colours, or their gradients, of view i."""
        return (colors[i] if self.view_colors else colors).detach()


class RasterizeSurfels(torch.autograd.Function):
    """One view after the other. It returns colours, alphas, normals, median and, if requested, distortion."""

    @staticmethod
    def forward(
        ctx: Any,
        means: Tensor,
        quats: Tensor,
        scales: Tensor,
        opacities: Tensor,
        colors: Tensor,
        viewmats: Tensor,
        Ks: Tensor,
        backgrounds: Tensor | None,
        shift: Tensor,
        options: SurfelOptions,
        states: list[Any],
    ) -> tuple[Tensor, ...]:
        geometry = [t.detach() for t in (means, quats, scales, opacities)]
        viewmats64, Ks64 = (t.detach().to(torch.float64).contiguous() for t in (viewmats, Ks))
        images = _empty_images(len(viewmats), colors.shape[-1], options)
        for i in range(len(viewmats)):
            state = native().surfels_forward(
                *geometry,
                options.colors_of(colors, i),
                options.sh_degree,
                viewmats64[i],
                Ks64[i],
                options.width,
                options.height,
                options.near_plane,
                options.far_plane,
                options.radius_clip,
                options.depth,
                None if backgrounds is None else backgrounds[i].detach(),
                images[0][i],
                images[1][i, ..., 0],
                images[2][i],
                images[3][i, ..., 0],
                images[4][i, ..., 0] if options.distortion else None,
            )
            if isinstance(state, tuple):
                field, row = state
                raise InputError(f"row {row} is not finite.", field=field, hint="find where the NaN or Inf comes from")
            states.append(state)
        ctx.states, ctx.options = tuple(states), options
        ctx.save_for_backward(means, quats, scales, opacities, colors, viewmats, Ks, backgrounds)
        ctx.set_materialize_grads(False)
        return images

    @staticmethod
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        means, quats, scales, opacities, colors, viewmats, Ks, backgrounds = ctx.saved_tensors
        need, options = ctx.needs_input_grad, ctx.options
        if all(g is None for g in grads):
            return (None,) * 11
        geometry = [t.detach() for t in (means, quats, scales, opacities)]
        out = [torch.empty_like(t) if n else None for t, n in zip(geometry, need[:4], strict=True)]
        # Zeros only where the second view adds to rows that the first did not write.
        new_colors = torch.zeros if options.view_colors and len(ctx.states) > 1 else torch.empty
        grad_colors = new_colors(colors.shape, dtype=torch.float32) if need[4] else None
        camera = torch.zeros(len(ctx.states), native().CAMERA_SUMS, dtype=torch.float64) if need[5] or need[6] else None
        grad_backgrounds = torch.zeros(backgrounds.shape, dtype=torch.float64) if need[7] else None
        grad_shift = torch.empty(len(ctx.states), len(means), 2) if need[8] else None
        for i, state in enumerate(ctx.states):
            native().surfels_backward(
                state,
                *geometry,
                options.colors_of(colors, i),
                options.sh_degree,
                None if backgrounds is None else backgrounds[i].detach(),
                *_image_gradients(grads, i),
                *out,
                None if grad_colors is None else options.colors_of(grad_colors, i),
                None if camera is None else camera[i],
                None if grad_backgrounds is None else grad_backgrounds[i],
                None if grad_shift is None else grad_shift[i],
                i > 0,
            )
        camera_grads = camera_gradients(camera, viewmats if need[5] else None, Ks if need[6] else None)
        grad_backgrounds = None if grad_backgrounds is None else grad_backgrounds.to(torch.float32)
        return (*out, grad_colors, *camera_grads, grad_backgrounds, grad_shift, None, None)


def _empty_images(views: int, channels: int, options: SurfelOptions) -> tuple[Tensor, ...]:
    """Return images without values: colours and depth, alphas, normals, median, distortion."""
    columns = (channels + int(options.depth != "none"), 1, 3, 1, *([1] if options.distortion else []))
    return tuple(torch.empty(views, options.height, options.width, n) for n in columns)


def _image_gradients(grads: tuple[Tensor | None, ...], i: int) -> list[Tensor | None]:
    """Return view i's five image gradients: (H, W, X) of colours and normals, (H, W) of the others, or None."""
    found: list[Tensor | None] = []
    for k in range(5):
        grad = grads[k] if k < len(grads) else None
        found.append(None if grad is None else (grad[i] if k in (0, 2) else grad[i, ..., 0]).contiguous())
    return found

"""Losses that refinement minimises."""

from __future__ import annotations

from typing import Any, Literal

import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize.native import native

Padding = Literal["same", "valid"]

_LEAST_DEPTH = 0.1  # [m]
WINDOW = 11  # [px] side of the window of SSIM


def l1(rendered: Tensor, observed: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean absolute difference, over ``mask`` if given (broadcast over channels); 0 for an empty mask."""
    return masked_mean((rendered - observed).abs(), mask)


def masked_mean(values: Tensor, mask: Tensor | None) -> Tensor:
    """Return the mean of values, over ``mask`` if given (broadcast over channels); 0 for an empty mask."""
    if mask is None:
        return values.mean()
    return (values * mask).sum() / mask.expand_as(values).sum().clamp_min(1)


def normal_consistency(normals: Tensor, depth_normals: Tensor, alpha: Tensor, mask: Tensor | None = None) -> Tensor:
    """Return the mean 1 - nᵀ N α of surfels (Huang et al. 2024, Eq. 14, as in their program), over ``mask`` if given.

    Args:
        normals: n (H, W, 3), the surfels' normals, blended.
        depth_normals: N (H, W, 3) of the rendered depth, unit vectors; 0 where unknown.
        alpha: α (H, W, 1); receives no gradient.
        mask: (H, W) bool.
    """
    return masked_mean(1 - (normals * depth_normals * alpha.detach()).sum(-1), mask)


def relative_depth_error(rendered: Tensor, depth: Tensor, mask: Tensor) -> Tensor:
    """Return the mean |(D - D*) / D*| of rendered depth D against measured depth D*, over ``mask``; all (H, W, 1) [m].

    Depth below 0.1 m counts as 0.1 m in the divisor.
    """
    scale = depth.clamp_min(_LEAST_DEPTH)
    return l1(rendered / scale, depth / scale, mask)


def l1_dssim(
    rendered: Tensor, target: Tensor, weight: float = 0.2, mask: Tensor | None = None, *, padding: Padding = "same"
) -> Tensor:
    """Return the colour loss of 3D Gaussian splatting: (1 - weight) L1 + weight (1 - SSIM), in one native pass.

    SSIM (Wang et al. 2004, equation 13) has a Gaussian window of 11x11 pixels, σ 1.5, and constants for values in 0..1.
    Both terms are means over pixels, channels and images. The result is the same, bit for bit, in every run
    and for any number of threads.

    Args:
        rendered: (H, W, D) or (C, H, W, D) float32; the gradient goes here.
        target: as ``rendered``; receives no gradient.
        weight: of the SSIM term, in 0..1.
        mask: (H, W) or (C, H, W), bool: pixels that count. Elsewhere ``rendered`` counts as equal to ``target``, whose
            values must be finite there as well: a window across the mask's border compares the inside alone.
            An empty mask gives 0.
        padding: "same": a window at each pixel, both images 0 outside; "valid": windows inside the image only.

    Returns:
        () float32.

    Raises:
        InputError: shapes, types or devices do not fit; a value is not finite; ``target`` requires a gradient; with
            "valid", the image is smaller than the window.
    """
    images = _images("rendered", rendered), _images("target", target)
    if rendered.shape != target.shape:
        raise InputError(f"is {tuple(target.shape)}, rendered {tuple(rendered.shape)}.", field="target")
    if target.requires_grad:
        raise InputError("requires a gradient, and receives none.", field="target", hint="pass target.detach()")
    if not 0.0 <= weight <= 1.0:
        raise InputError(f"is {weight}.", field="weight", hint="give a share of 0 to 1")
    if padding not in ("same", "valid"):
        raise InputError(f"is {padding!r}.", field="padding", hint="one of 'same', 'valid'")
    if padding == "valid" and min(images[0].shape[1:3]) < WINDOW:
        size = tuple(images[0].shape[1:3])
        raise InputError(f"is {size}.", field="rendered", hint=f"'valid' needs {WINDOW} pixels each way; use 'same'")
    value: Tensor = _L1Dssim.apply(*images, _mask(mask, rendered), float(weight), padding == "valid")
    return value


class _L1Dssim(torch.autograd.Function):
    """The gradient is found along with the value: it shares most of the work, and callers need both."""

    @staticmethod
    def forward(
        ctx: Any, rendered: Tensor, target: Tensor, mask: Tensor | None, weight: float, inside_only: bool
    ) -> Tensor:
        ctx.options = (weight, inside_only)
        ctx.gradient = torch.empty_like(rendered) if ctx.needs_input_grad[0] else None
        value = native().l1_dssim(rendered.detach(), target.detach(), mask, weight, inside_only, ctx.gradient)
        if not -1e30 < value < 1e30:
            raise _not_finite(rendered, target, mask)
        ctx.save_for_backward(rendered, target, mask)
        return torch.tensor(value, dtype=torch.float32)

    @staticmethod
    @torch.autograd.function.once_differentiable
    def backward(ctx: Any, grad: Tensor) -> tuple[Tensor | None, ...]:
        rendered, target, mask = ctx.saved_tensors
        gradient, ctx.gradient = ctx.gradient, None  # handed over, not copied
        if gradient is None:  # a second pass over a retained graph
            gradient = torch.empty_like(rendered)
            native().l1_dssim(rendered.detach(), target.detach(), mask, *ctx.options, gradient)
        if float(grad) != 1.0:
            gradient *= grad
        return (gradient, None, None, None, None)


def _images(name: str, tensor: Tensor) -> Tensor:
    """Return images as contiguous (C, H, W, D)."""
    if not isinstance(tensor, Tensor):
        raise InputError(f"is a {type(tensor).__name__}.", field=name, hint="give a torch tensor")
    if tensor.ndim not in (3, 4) or tensor.numel() == 0:
        raise InputError(f"is {tuple(tensor.shape)}.", field=name, hint="give (H, W, D) or (C, H, W, D), not empty")
    if tensor.dtype != torch.float32:
        raise InputError(f"is {tensor.dtype}.", field=name, hint=f"pass {name}.float()")
    if tensor.device.type != "cpu":
        raise InputError(f"is on {tensor.device}.", field=name, hint=f"pass {name}.cpu()")
    return (tensor if tensor.ndim == 4 else tensor[None]).contiguous()


def _mask(mask: Tensor | None, like: Tensor) -> Tensor | None:
    """Return a mask as contiguous bytes (C, H, W)."""
    if mask is None:
        return None
    if mask.dtype != torch.bool or mask.shape != like.shape[:-1] or mask.device.type != "cpu":
        wanted = tuple(like.shape[:-1])
        raise InputError(f"is {tuple(mask.shape)}, {mask.dtype}.", field="mask", hint=f"give bool {wanted} on the CPU")
    return (mask if mask.ndim == 3 else mask[None]).contiguous().view(torch.uint8)


def _not_finite(rendered: Tensor, target: Tensor, mask: Tensor | None) -> InputError:
    counted = torch.isfinite(rendered) if mask is None else torch.isfinite(rendered) | (mask == 0)[..., None]
    for name, finite in (("rendered", counted), ("target", torch.isfinite(target))):
        if not finite.all():
            image, row, column, channel = (~finite).nonzero()[0].tolist()
            where = f"image {image}, row {row}, column {column}, channel {channel}"
            return InputError(f"{where} is not finite.", field=name, hint="find where the NaN or Inf comes from")
    return InputError("has values too large for their squares.", field="rendered", hint="scale colours to 0..1")

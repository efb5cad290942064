"""The rasterizer as a node of torch's graph."""

from __future__ import annotations

from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatbot.rasterize.centers import Centers
from splatbot.rasterize.inputs import Inputs, Layout
from splatbot.rasterize.options import RasterOptions
from splatbot.rasterize.passes import Rendered, Wanted, run_backward

_SPARSE = 4  # number of leading inputs that may have sparse gradients: means, quats, scales, covars


def attach(
    inputs: Inputs, options: RasterOptions, rendered: Rendered, centers: Centers, means2d: Tensor
) -> tuple[Tensor, Tensor]:
    """Return the rendered images as functions of the inputs and of the projected centres."""
    renders, alphas = _Rasterize.apply(*inputs.tensors(), means2d, inputs.layout, options, rendered, centers)
    return renders, alphas


class _Rasterize(torch.autograd.Function):
    """Images that have been rendered already, with the gradients of how they were."""

    @staticmethod
    def forward(ctx: Any, *arguments: Any) -> tuple[Tensor, Tensor]:
        *tensors, _, layout, options, rendered, centers = arguments
        ctx.layout, ctx.options, ctx.centers = layout, options, centers
        ctx.states = rendered.states  # not the images: they own this node
        ctx.save_for_backward(*tensors)
        ctx.set_materialize_grads(False)
        return rendered.renders, rendered.alphas

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, *grads: Tensor | None) -> tuple[Tensor | None, ...]:
        grad_renders, grad_alphas = grads
        if grad_renders is None and grad_alphas is None:
            return (None,) * 15
        inputs = Inputs(ctx.layout, *ctx.saved_tensors)
        wanted = Wanted(ctx.needs_input_grad[:10], *ctx.centers.wanted())
        found = run_backward(inputs, ctx.options, ctx.states, grad_renders, grad_alphas, wanted)
        means2d = ctx.centers.receive(found.means2d, found.absolute2d)
        gradients = found.inputs
        if ctx.options.sparse_grad:
            rows = _rows_in_view(ctx.layout, ctx.states)
            gradients[:_SPARSE] = [None if g is None else _sparse(g, rows) for g in gradients[:_SPARSE]]
        return (*gradients, means2d, None, None, None, None)


def _rows_in_view(layout: Layout, states: tuple[Any, ...]) -> Tensor:
    """Return indices of the Gaussians that any view sees, ascending."""
    seen = torch.zeros(layout.n_gaussians, dtype=torch.bool)
    for state in states:
        seen[torch.from_numpy(state.visible())] = True
    return seen.nonzero()[:, 0]


def _sparse(gradient: Tensor, rows: Tensor) -> Tensor:
    return torch.sparse_coo_tensor(
        rows[None], gradient[rows], gradient.shape, is_coalesced=True, check_invariants=False
    )

"""The projected centres as gsplat's strategies need them: a tensor of the graph whose gradient can be kept.

The rasterizer pulls gradients back to the Gaussians without stopping at the image. ``retain_grad()``, hooks and
losses on ``meta["means2d"]`` still work: that tensor is an input of the rasterizing node, which gives it the gradient
of the centres. On the way back this part of its gradient is removed again, because the rasterizer has already
propagated it to the Gaussians.
"""

from __future__ import annotations

import functools
import weakref
from typing import Any

import torch
from torch import Tensor
from torch.autograd.function import once_differentiable

from splatbot.errors import InputError
from splatbot.rasterize.inputs import Inputs, Layout


class Centers:
    """State of the projected centres that the two nodes and the meta share.

    Args:
        layout: of the render's inputs.
        states: rows of the views' passes in packed layout. If None, the layout is not packed.
        absgrad: whether absolute gradients are to be found.
        pinhole: whether the views are plain pinholes; only then may a loss be put on the tensor itself.
    """

    def __init__(self, layout: Layout, states: tuple[Any, ...] | None, *, absgrad: bool, pinhole: bool) -> None:
        self.layout = layout
        self._states = states
        self.absgrad = absgrad
        self._pinhole = pinhole
        self.exposed = False  # whether a caller holds the tensor and may read its gradient
        self._tensor: weakref.ref[Tensor] | None = None
        self._rendered: tuple[int, Tensor] | None = None  # graph task, gradient from the rasterizing node

    def new_tensor(self, inputs: Inputs) -> Tensor:
        """Return the tensor, (..., C, N, 2) or (P, 2), of undefined values; belongs to the graph of its inputs."""
        tensor: Tensor = _Means2d.apply(inputs.means, inputs.viewmats, inputs.Ks, self)
        self._tensor = weakref.ref(tensor)
        return tensor

    @functools.cached_property
    def ids(self) -> Tensor | None:
        """Rows (P,) in view among the (views x N,) rows, in packed layout. If None, all rows."""
        if self._states is None:
            return None
        n = self.layout.n_gaussians
        rows = [torch.from_numpy(state.visible()) + i * n for i, state in enumerate(self._states)]
        return torch.cat(rows) if rows else torch.zeros(0, dtype=torch.int64)

    @property
    def shape(self) -> tuple[int, ...]:
        if self._states is not None:
            return (sum(state.n_visible for state in self._states), 2)
        return (*self.layout.views, self.layout.n_gaussians, 2)

    def wanted(self) -> tuple[bool, bool]:
        """Return whether gradients and absolute gradients are needed: only if a caller can read them."""
        tensor = None if self._tensor is None else self._tensor()
        if tensor is None or not tensor.requires_grad:
            return False, False
        return self.exposed, self.absgrad

    def receive(self, gradient: Tensor | None, absolute: Tensor | None) -> Tensor | None:
        """Take (views, N, 2) gradients from the rasterizer; the gradient in the tensor's shape."""
        tensor = None if self._tensor is None else self._tensor()
        if absolute is not None and tensor is not None:
            tensor.absgrad = self._shaped(absolute)  # type: ignore[attr-defined]
        if gradient is None:
            return None
        shaped = self._shaped(gradient)
        self._rendered = (torch._C._current_graph_task_id(), shaped)
        return shaped

    def besides_rendering(self, gradient: Tensor) -> Tensor | None:
        """Return the part of the tensor's gradient that did not come from the rasterizer."""
        rendered, self._rendered = self._rendered, None
        if rendered is None or rendered[0] != torch._C._current_graph_task_id():
            return gradient
        return None if torch.equal(gradient, rendered[1]) else gradient - rendered[1]

    def project(self, means: Tensor, viewmats: Tensor, Ks: Tensor) -> Tensor:
        """Return the pinhole projection [px] of the rows of the tensor, in float64."""
        if not self._pinhole:
            raise InputError("takes no loss of its own here.", field="means2d", hint="only of plain pinhole cameras")
        layout = self.layout
        lead = (layout.n_batches, layout.n_cameras)
        T = viewmats.reshape(*lead, 4, 4).double()
        points = means.reshape(layout.n_batches, 1, -1, 3).double() @ T[..., :3, :3].mT + T[..., None, :3, 3]
        points = points.reshape(-1, 3)
        ids = torch.arange(len(points)) if self.ids is None else self.ids
        p, k = points[ids], Ks.reshape(-1, 3, 3).double()[ids // max(layout.n_gaussians, 1)]
        uv = p[:, :2] / p[:, 2:] * k.diagonal(dim1=-2, dim2=-1)[:, :2] + k[:, :2, 2]
        return uv.reshape(self.shape)

    def _shaped(self, rows: Tensor) -> Tensor:
        return rows.reshape(self.shape) if self.ids is None else rows.reshape(-1, 2)[self.ids]


class _Means2d(torch.autograd.Function):
    """Gives the projected centres their place in the graph."""

    @staticmethod
    def forward(ctx: Any, means: Tensor, viewmats: Tensor, Ks: Tensor, centers: Centers) -> Tensor:
        ctx.centers = centers
        ctx.save_for_backward(means, viewmats, Ks)
        ctx.set_materialize_grads(False)
        return torch.empty(centers.shape, dtype=torch.float32)

    @staticmethod
    @once_differentiable
    def backward(ctx: Any, gradient: Tensor | None) -> tuple[Tensor | None, ...]:
        rest = None if gradient is None else ctx.centers.besides_rendering(gradient)
        if rest is None:
            return (None,) * 4
        leaves = [t.detach().requires_grad_() for t in ctx.saved_tensors]
        with torch.enable_grad():
            projected = ctx.centers.project(*leaves)
        return (*torch.autograd.grad(projected, leaves, rest.double()), None)

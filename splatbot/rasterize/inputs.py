"""Checks of the inputs of a render: shapes, types, devices. Values are checked in C++, where they are read anyway."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize.options import DEFAULT_TILE_SIZE, parse_mode
from splatbot.rasterize.scene import Gaussians, Viewpoints

MAX_SH_DEGREE = 4
_MOST_SKEW = 1e-2  # difference of R Rᵀ from the identity


@dataclass(frozen=True)
class Layout:
    """How the tensors of B scenes of N Gaussians, seen by C views each, are arranged.

    Without leading batch dimensions (``batch`` is ()), tensors have the shapes of :func:`rasterization`; with them,
    the batch dimensions are flattened to one, B.
    """

    batch: tuple[int, ...]
    n_cameras: int
    n_gaussians: int
    view_colors: bool  # colours differ from view to view

    @property
    def n_batches(self) -> int:
        return math.prod(self.batch)

    @property
    def n_views(self) -> int:
        return self.n_batches * self.n_cameras

    @property
    def views(self) -> tuple[int, ...]:
        """Leading dimensions of values per view."""
        return (*self.batch, self.n_cameras)

    def scene(self, tensor: Tensor, b: int) -> Tensor:
        """Return the part of a tensor that belongs to scene b."""
        return tensor[b] if self.batch else tensor

    def view(self, tensor: Tensor, b: int, c: int) -> Tensor:
        """Return the part of a tensor that belongs to view c of scene b."""
        return tensor[b, c] if self.batch else tensor[c]

    def colors_of(self, colors: Tensor, b: int, c: int) -> Tensor:
        """Return colours, or their gradients, of view c of scene b."""
        return self.view(colors, b, c) if self.view_colors else self.scene(colors, b)


@dataclass(frozen=True)
class Inputs:
    """Checked tensors: float32 (cameras may be float64), CPU, contiguous."""

    layout: Layout
    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    covars: Tensor | None
    opacities: Tensor
    colors: Tensor  # of D channels, or coefficients
    viewmats: Tensor
    Ks: Tensor
    backgrounds: Tensor | None
    motion: Tensor | None = None  # of rolling shutters, float64; the kernels read it from the lenses
    masks: Tensor | None = None  # uint8

    def tensors(self) -> tuple[Tensor | None, ...]:
        """Return the differentiable inputs, in the order of the fields."""
        return (
            self.means,
            self.quats,
            self.scales,
            self.covars,
            self.opacities,
            self.colors,
            self.viewmats,
            self.Ks,
            self.backgrounds,
            self.motion,
        )

    def detached(self) -> Inputs:
        """Return the same values outside the graph."""
        tensors = (t if t is None else t.detach() for t in (*self.tensors(), self.masks))
        return Inputs(self.layout, *tensors)  # type: ignore[arg-type]


def check_inputs(
    gaussians: Gaussians,
    views: Viewpoints,
    render_mode: str,
    *,
    masks: Tensor | None = None,
    tile_size: int = DEFAULT_TILE_SIZE,
) -> Inputs:
    """Check, make contiguous and flatten the batch dimensions; colours that are not rendered become (N, 0).

    Args:
        gaussians: of every view.
        views: poses, image size and backgrounds.
        render_mode: colours and backgrounds have no effect on a mode without colours.
        masks: see ``rasterization``.
        tile_size: of the tiles of ``masks`` [px].

    Raises:
        InputError: naming the argument.
    """
    wants_color, _ = parse_mode(render_mode)
    colors, sh_degree, backgrounds = gaussians.colors, gaussians.sh_degree, views.backgrounds
    if not wants_color:
        colors = sh_degree = backgrounds = None
    elif colors is None:
        raise InputError(f"is missing for {render_mode}.", field="colors", hint="give colours, or render_mode='D'")
    for name, pixels in (("width", views.width), ("height", views.height), ("tile_size", tile_size)):
        if isinstance(pixels, bool) or not isinstance(pixels, int) or pixels < 1:
            raise InputError(f"is {pixels!r}.", field=name, hint="give a positive integer [px]")
    _require_tensor("means", gaussians.means)
    batch = tuple(gaussians.means.shape[:-2])
    means = _floats("means", gaussians.means, (*batch, None, 3))
    n = means.shape[-2]
    viewmats = _floats("viewmats", views.viewmats, (*batch, None, 4, 4), double=True)
    c = viewmats.shape[-3]
    Ks = _floats("Ks", views.Ks, (*batch, c, 3, 3), double=True)
    _check_cameras(viewmats, Ks)
    quats = scales = covars = None
    if gaussians.covars is not None:
        covars = _floats("covars", gaussians.covars, (*batch, n, 3, 3))
    else:
        quats = _floats("quats", gaussians.quats, (*batch, n, 4))
        scales = _floats("scales", gaussians.scales, (*batch, n, 3))
    colors, view_colors = _check_colors(colors, sh_degree, means, (*batch, c))
    channels = colors.shape[-1]
    if backgrounds is not None:
        backgrounds = _floats("backgrounds", backgrounds, (*batch, c, channels))
        if not torch.isfinite(backgrounds).all():
            raise InputError("is not finite.", field="backgrounds")
    if masks is not None:
        masks = _check_masks(masks, (*batch, c, -(-views.height // tile_size), -(-views.width // tile_size)))

    opacities = _floats("opacities", gaussians.opacities, (*batch, n))
    tensors = (means, quats, scales, covars, opacities, colors, viewmats, Ks, backgrounds, None, masks)
    flat = [t if t is None or not batch else t.reshape(-1, *t.shape[len(batch) :]) for t in tensors]
    return Inputs(Layout(batch, c, n, view_colors), *flat)  # type: ignore[arg-type]


def _check_colors(
    colors: Tensor | None, sh_degree: int | None, means: Tensor, views: tuple[int, ...]
) -> tuple[Tensor, bool]:
    """Return colours, and whether each view has its own; ``views`` are the batch dimensions and C."""
    batch, n = tuple(means.shape[:-2]), means.shape[-2]
    if colors is None:
        return means.new_zeros(*batch, n, 0), False
    _require_tensor("colors", colors)
    tail: tuple[int | None, ...] = (n, None) if sh_degree is None else (n, None, 3)
    own = colors.ndim == len(views) + len(tail)
    checked = _floats("colors", colors, (*(views if own else batch), *tail))
    if sh_degree is None and checked.shape[-1] == 0:
        raise InputError("has no channels.", field="colors", hint="give colours (N, D), D >= 1")
    if sh_degree is not None:
        if isinstance(sh_degree, bool) or not isinstance(sh_degree, int) or not 0 <= sh_degree <= MAX_SH_DEGREE:
            raise InputError(f"is {sh_degree!r}.", field="sh_degree", hint=f"give 0 to {MAX_SH_DEGREE}, or None")
        if checked.shape[-2] < (sh_degree + 1) ** 2:
            needed = f"{(sh_degree + 1) ** 2} coefficients a channel for degree {sh_degree}"
            raise InputError(f"holds {checked.shape[-2]}.", field="colors", hint=f"give at least {needed}")
    return checked, own


def _check_masks(masks: Tensor, shape: tuple[int, ...]) -> Tensor:
    _require_tensor("masks", masks)
    if tuple(masks.shape) != shape or masks.dtype != torch.bool:
        raise InputError(f"is {masks.dtype} {tuple(masks.shape)}, expected torch.bool {shape}.", field="masks")
    return masks.cpu().contiguous().view(torch.uint8)


def _require_tensor(name: str, tensor: object) -> None:
    if not isinstance(tensor, Tensor):
        raise InputError(f"is a {type(tensor).__name__}.", field=name, hint="give a torch tensor")


def _floats(name: str, tensor: Tensor | None, shape: tuple[int | None, ...], *, double: bool = False) -> Tensor:
    if not isinstance(tensor, Tensor):
        raise InputError(f"is a {type(tensor).__name__}.", field=name, hint="give a torch tensor")
    fits = tensor.ndim == len(shape) and all(
        want is None or got == want for got, want in zip(tensor.shape, shape, strict=True)
    )
    if not fits:
        wanted = ", ".join("*" if s is None else str(s) for s in shape)
        raise InputError(f"is {tuple(tensor.shape)}, expected ({wanted}).", field=name)
    if tensor.dtype != torch.float32 and not (double and tensor.dtype == torch.float64):
        raise InputError(f"is {tensor.dtype}.", field=name, hint=f"pass {name}.float()")
    if tensor.device.type != "cpu":
        raise InputError(f"is on {tensor.device}.", field=name, hint=f"pass {name}.cpu()")
    return tensor.contiguous()


def _check_cameras(viewmats: Tensor, Ks: Tensor) -> None:
    for name, tensor in (("viewmats", viewmats), ("Ks", Ks)):
        width = tensor.shape[-1] * tensor.shape[-2]
        for i, row in enumerate(tensor.detach().reshape(-1, width).tolist()):
            if not all(map(math.isfinite, row)):
                raise InputError(f"row {i} is not finite.", field=name)
            if name == "Ks":
                _check_intrinsics(i, row)
            else:
                _check_rigid(i, row)


def _check_rigid(i: int, row: list[float]) -> None:
    """Refuse a transform (16 numbers) that scales, shears or mirrors; a Gaussian's image would not be that of a view.

    Steps of a gradient descent leave a matrix rigid within 1 %.
    """
    x, y, z = row[0:3], row[4:7], row[8:11]
    products = ((x, x, 1.0), (y, y, 1.0), (z, z, 1.0), (x, y, 0.0), (y, z, 0.0), (z, x, 0.0))
    skew = max(abs(a[0] * b[0] + a[1] * b[1] + a[2] * b[2] - want) for a, b, want in products)
    turned = [x[1] * y[2] - x[2] * y[1], x[2] * y[0] - x[0] * y[2], x[0] * y[1] - x[1] * y[0]]
    if skew > _MOST_SKEW or turned[0] * z[0] + turned[1] * z[1] + turned[2] * z[2] <= 0.0:
        hint = "give rigid transforms of the world to the camera; scale the scene instead"
        raise InputError(f"row {i} scales, shears or mirrors.", field="viewmats", hint=hint)


def _check_intrinsics(i: int, row: list[float]) -> None:
    if not (row[0] > 0.0 and row[4] > 0.0):
        raise InputError(f"row {i} has focal lengths {row[0]:g}, {row[4]:g}.", field="Ks", hint="positive [px]")
    if row[1] != 0.0 or row[3] != 0.0:
        raise InputError(f"row {i} has skew.", field="Ks", hint="undistort to a camera without skew")

"""Checks of what a render is given: shapes, types, devices. Values are checked in C++, where they are read anyway."""

from __future__ import annotations

import math
from dataclasses import dataclass

import torch
from torch import Tensor

from splatbot.errors import InputError


@dataclass(frozen=True)
class Inputs:
    """Checked tensors: float32, CPU, contiguous; ``viewmats`` may be float64, ``Ks`` is."""

    means: Tensor
    quats: Tensor
    scales: Tensor
    opacities: Tensor
    colors: Tensor
    viewmats: Tensor
    Ks: Tensor
    backgrounds: Tensor | None

    def tensors(self) -> tuple[Tensor | None, ...]:
        """The differentiable ones, in the order of ``rasterization``; backgrounds last."""
        return (
            self.means,
            self.quats,
            self.scales,
            self.opacities,
            self.colors,
            self.viewmats,
            self.backgrounds,
        )


def check_inputs(
    means: Tensor,
    quats: Tensor,
    scales: Tensor,
    opacities: Tensor,
    colors: Tensor | None,
    viewmats: Tensor,
    Ks: Tensor,
    backgrounds: Tensor | None,
    width: int,
    height: int,
) -> Inputs:
    """Check and make contiguous; ``colors`` None becomes (N, 0).

    Raises:
        InputError: naming the argument.
    """
    for name, size in (("width", width), ("height", height)):
        if isinstance(size, bool) or not isinstance(size, int) or size < 1:
            raise InputError(f"is {size!r}.", field=name, hint="give a positive integer [px]")
    n = len(_floats("means", means, (None, 3)))
    poses = _floats("viewmats", viewmats, (None, 4, 4), double=True)
    c = len(poses)
    intrinsics = _floats("Ks", Ks, (c, 3, 3), double=True).detach().to(torch.float64)
    _check_camera(poses, intrinsics)
    given = colors is not None
    if colors is None:
        colors = means.new_zeros(n, 0)
    shape = (n, None) if colors.ndim == 2 else (c, n, None)
    checked = _floats("colors", colors, shape)
    if given and checked.shape[-1] == 0:
        raise InputError("has no channels.", field="colors", hint="give colours (N, D), D >= 1")
    if backgrounds is not None:
        backgrounds = _floats("backgrounds", backgrounds, (c, checked.shape[-1]))
        if not torch.isfinite(backgrounds).all():
            raise InputError("is not finite.", field="backgrounds")
    return Inputs(
        means=_floats("means", means, (n, 3)),
        quats=_floats("quats", quats, (n, 4)),
        scales=_floats("scales", scales, (n, 3)),
        opacities=_floats("opacities", opacities, (n,)),
        colors=checked,
        viewmats=poses,
        Ks=intrinsics.contiguous(),
        backgrounds=backgrounds,
    )


def _floats(name: str, tensor: Tensor, shape: tuple[int | None, ...], *, double: bool = False) -> Tensor:
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


def _check_camera(viewmats: Tensor, Ks: Tensor) -> None:
    for name, tensor in (("viewmats", viewmats), ("Ks", Ks)):
        for i, row in enumerate(tensor.detach().flatten(1).tolist()):
            if not all(map(math.isfinite, row)):
                raise InputError(f"row {i} is not finite.", field=name)
            if name == "Ks" and not (row[0] > 0.0 and row[4] > 0.0):
                raise InputError(f"row {i} has focal lengths {row[0]:g}, {row[4]:g}.", field=name, hint="positive [px]")
            if name == "Ks" and (row[1] != 0.0 or row[3] != 0.0):
                raise InputError(f"row {i} has skew.", field=name, hint="undistort to a camera without skew")

"""Gaussians and the views that show them: the arguments that every renderer takes."""

from __future__ import annotations

from dataclasses import dataclass

from torch import Tensor


@dataclass(frozen=True)
class Gaussians:
    """N Gaussians or surfels; the fields are the arguments of ``rasterization`` of the same names."""

    means: Tensor
    quats: Tensor | None
    scales: Tensor | None
    opacities: Tensor
    colors: Tensor | None = None
    covars: Tensor | None = None
    sh_degree: int | None = None


@dataclass(frozen=True)
class Viewpoints:
    """Poses, intrinsics and backgrounds of C views of one size; the fields are the arguments of ``rasterization``."""

    viewmats: Tensor
    Ks: Tensor
    width: int
    height: int
    backgrounds: Tensor | None = None

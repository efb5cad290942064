"""Settings of a training run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from typing import Any, Literal

import torch
from torch import Tensor

from splatbot.config import MappingConfig
from splatbot.errors import InputError
from splatbot.layouts import DatasetKind
from splatbot.optimize.strategies import DefaultStrategy, MCMCStrategy, Strategy

USUAL: Mapping[DatasetKind, Mapping[str, Any]] = {
    "run": {
        "strategy": "fixed",
        "depth_weight": MappingConfig().depth_weight,
        "keep_surfaces": True,
        "coarse_share": 0.0,
    },
    "blender": {"strategy": "default", "background": "white"},
    "colmap": {"strategy": "mcmc"},
    "nerfstudio": {"strategy": "mcmc"},
}
"""Options that suit a kind of dataset. The depth of a run covers its surfaces. Photographs of the real world have
errors that clones follow into floaters; rendered ones do not."""

_MOST_GAUSSIANS = 200_000
_PIXELS_EACH = 100

StrategyName = Literal["default", "absgrad", "mcmc", "fixed"]
Background = Literal["black", "white", "random"]


@dataclass(frozen=True)
class TrainingOptions:
    """Length and kind of a training. A run ends at the first of ``iterations`` and ``minutes``.

    Args:
        iterations: steps of the optimizer; None for no limit.
        minutes: time of training, without the evaluations; None for no limit. The schedule follows the clock then, so
            that two runs differ.
        strategy: "default" (Kerbl et al. 2023), "absgrad" (Ye et al. 2024), "mcmc" (Kheradmand et al. 2024), or
            "fixed", which keeps the Gaussians of the start.
        max_gaussians: largest number of Gaussians. None for one for each 100 pixels of the training views, at most
            200,000: few views do not determine more, and held-out views get worse.
        sh_degree: of the final map, 0 to 4; it grows from 0 in the course of the run.
        background: behind images with alpha.
        dssim_weight: λ of the loss (1 - λ) L1 + λ (1 - SSIM).
        depth_weight: weight of the relative depth error where views have depth.
        keep_surfaces: limit the motion of Gaussians along their normals and keep them thin discs, as mapping does. The
            collision field of a mapped log stays true.
        opacity_weight, scale_weight: weights of the mean opacity and the mean σ [1/m]; None for 0.01 with "mcmc" and 0
            otherwise.
        refine_poses: estimate a correction of each camera pose.
        refine_intrinsics: estimate fx, fy, cx and cy of each camera; its lens distortion is fixed.
        exposure: estimate an affine colour transform of the map for each photograph.
        antialiased: render with opacities that compensate the low-pass filter (Yu et al. 2024).
        surfels: train discs, 2D Gaussian splatting (Huang et al. 2024).
        normal_weight: of the normal consistency of surfels, in the later part of the run.
        distortion_weight: of their distortion [share of the scene's extent]; see :mod:`splatbot.training.surface`.
        coarse_share: share of the run at half the resolution or less.
        seed: of all random draws.
        batch: images of each step; their mean loss is minimized.
    """

    iterations: int | None = 7_000
    minutes: float | None = None
    strategy: StrategyName = "default"
    max_gaussians: int | None = None
    sh_degree: int = 3
    background: Background = "black"
    dssim_weight: float = 0.2
    depth_weight: float = 0.1
    keep_surfaces: bool = False
    opacity_weight: float | None = None
    scale_weight: float | None = None
    refine_poses: bool = False
    refine_intrinsics: bool = False
    exposure: bool = False
    antialiased: bool = False
    surfels: bool = False
    normal_weight: float = 0.05
    distortion_weight: float = 0.01
    coarse_share: float = 0.3
    seed: int = 0
    batch: int = 1

    def __post_init__(self) -> None:
        if self.iterations is None and self.minutes is None:
            raise InputError("has no end.", field="iterations", hint="give a number of iterations or of minutes")
        for name, least, most in (
            ("iterations", 1, 10_000_000),
            ("minutes", 0.01, 100_000),
            ("max_gaussians", 1, 20_000_000),
            ("sh_degree", 0, 4),
            ("dssim_weight", 0, 1),
            ("depth_weight", 0, 100),
            ("opacity_weight", 0, 100),
            ("scale_weight", 0, 100),
            ("normal_weight", 0, 100),
            ("distortion_weight", 0, 100),
            ("coarse_share", 0, 1),
            ("seed", 0, 2**31),
            ("batch", 1, 1024),
        ):
            value = getattr(self, name)
            if value is not None and not least <= value <= most:
                raise InputError(f"is {value:g}.", field=name, hint=f"give {least:g} to {most:g}")
        if self.surfels and self.strategy == "absgrad":
            hint = "use the strategy default or mcmc"
            raise InputError("have no absolute gradients, which absgrad needs.", field="surfels", hint=hint)
        if self.surfels and self.antialiased:
            hint = "leave antialiased or surfels out"
            raise InputError("have a fixed low-pass filter, which antialiased replaces.", field="surfels", hint=hint)

    @property
    def regularizers(self) -> tuple[float, float]:
        """Return the weights of opacities and scales."""
        usual = 0.01 if self.strategy == "mcmc" else 0.0
        opacity, scale = self.opacity_weight, self.scale_weight
        return usual if opacity is None else opacity, usual if scale is None else scale

    @property
    def shade(self) -> Tensor:
        """The colour (3,) behind images with alpha; black where training draws it at random."""
        return torch.full((3,), float(self.background == "white"))

    @property
    def keeps_frame(self) -> bool:
        """Return whether the trained map keeps surfaces and world frame of the start, so that it can replace it."""
        refined = self.refine_poses or self.refine_intrinsics
        return self.keep_surfaces and self.strategy == "fixed" and not refined and not self.surfels

    def capped(self, pixels: int) -> TrainingOptions:
        """Return the options with ``max_gaussians`` for training views of ``pixels`` pixels in all."""
        if self.max_gaussians is not None:
            return self
        return replace(self, max_gaussians=max(1, min(_MOST_GAUSSIANS, pixels // _PIXELS_EACH)))

    def make_strategy(self) -> Strategy:
        """Return the strategy with its cap."""
        if self.strategy == "fixed":
            return Strategy()
        cap = self.max_gaussians or _MOST_GAUSSIANS
        if self.strategy == "mcmc":
            return MCMCStrategy(cap_max=cap)
        if self.surfels:  # values of gsplat's trainer of surfels
            return DefaultStrategy(cap_max=cap, prune_opa=0.05, key_for_gradient="gradient_2dgs")
        absgrad = self.strategy == "absgrad"
        return DefaultStrategy(cap_max=cap, absgrad=absgrad, grow_grad2d=0.0008 if absgrad else 0.0002)

"""Rendering of Gaussians, forwards and backwards."""

from __future__ import annotations

from splatbot.rasterize.cameras import RollingShutterType, UnscentedTransformParameters
from splatbot.rasterize.rasterization import rasterization
from splatbot.rasterize.reference import rasterization_reference
from splatbot.rasterize.reference_surfels import rasterization_2dgs_reference
from splatbot.rasterize.scene import Gaussians, Viewpoints
from splatbot.rasterize.sparse import (
    Contributors,
    contributing_gaussians,
    rasterize_pixels,
    rasterize_tiles,
    visible_gaussians,
)
from splatbot.rasterize.surfels import rasterization_2dgs

__all__ = [
    "Contributors",
    "Gaussians",
    "RollingShutterType",
    "UnscentedTransformParameters",
    "Viewpoints",
    "contributing_gaussians",
    "rasterization",
    "rasterization_2dgs",
    "rasterization_2dgs_reference",
    "rasterization_reference",
    "rasterize_pixels",
    "rasterize_tiles",
    "visible_gaussians",
]

"""Rendering of Gaussians, forwards and backwards."""

from __future__ import annotations

from splatbot.rasterize.rasterization import rasterization
from splatbot.rasterize.reference import rasterization_reference
from splatbot.rasterize.reference_surfels import rasterization_2dgs_reference
from splatbot.rasterize.surfels import rasterization_2dgs

__all__ = ["rasterization", "rasterization_2dgs", "rasterization_2dgs_reference", "rasterization_reference"]

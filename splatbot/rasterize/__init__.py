"""Rendering of Gaussians, forwards and backwards."""

from __future__ import annotations

from splatbot.rasterize.rasterization import rasterization
from splatbot.rasterize.reference import rasterization_reference

__all__ = ["rasterization", "rasterization_reference"]

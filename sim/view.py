"""Rendered images with depth, and their composition."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.rasterize.views import CONSTANTS as VIEWS

Image = NDArray[np.float32]


@dataclass(frozen=True, eq=False)
class TwinView:
    """View of a part of the world on a transparent background.

    Args:
        color: (H, W, 3) RGB in 0..1, premultiplied by ``alpha``.
        alpha: (H, W) fraction of the pixel that is covered.
        depth: (H, W) along the optical axis [m]; infinite where the pixel is empty.
        bodies: (H, W) fraction of the pixel that shows bodies of the simulation, not the map.
    """

    color: Image
    alpha: Image
    depth: Image
    bodies: Image

    def rgb(self) -> NDArray[np.uint8]:
        """Return the image (H, W, 3) on black."""
        return np.rint(255.0 * self.color.clip(0.0, 1.0)).astype(np.uint8)

    def measured(self, reach: float) -> Image:
        """Return depth (H, W) [m] as in a frame: 0 where the pixel is mostly empty, or beyond ``reach`` [m]."""
        seen = (self.alpha >= VIEWS.min_alpha) & (self.depth <= reach)
        return np.where(seen, self.depth, np.float32(0))


def composite(a: TwinView, b: TwinView) -> TwinView:
    """Composite two views per pixel by depth with the over operator (Porter and Duff 1984), which keeps soft edges."""
    first = a.depth <= b.depth

    def pick(x: Image, y: Image) -> tuple[Image, Image]:
        choice = first[..., None] if x.ndim == 3 else first
        return np.where(choice, x, y), np.where(choice, y, x)

    alpha, under = pick(a.alpha, b.alpha)
    rest = 1.0 - alpha
    color, color_under = pick(a.color, b.color)
    bodies, bodies_under = pick(a.bodies, b.bodies)
    depth, depth_under = pick(a.depth, b.depth)
    return TwinView(
        color + rest[..., None] * color_under,
        alpha + rest * under,
        np.where((alpha >= VIEWS.min_alpha) | (under < VIEWS.min_alpha), depth, depth_under),
        bodies + rest * bodies_under,
    )

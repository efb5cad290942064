"""The tiles of a tiled map that a view shows, by their numbers."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.camera import Camera
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse
from splatbot.protocols import Array
from splatbot.tiles import TiledMap


@dataclass(frozen=True)
class TileCover:
    """Tiles that cover a view.

    Args:
        numbers: of the tiles in the index; none of them is an ancestor of another.
        pixel_error: largest edge of a cell of merged Gaussians in the view [px].
    """

    numbers: tuple[int, ...]
    pixel_error: float


class ViewedTiles(TiledMap):
    """A tiled map for viewers, which keep the tiles that they have and receive those that they lack."""

    @property
    def most(self) -> int:
        """Largest number of Gaussians of a cover: those of the memory."""
        return self._most

    def coarsest(self) -> TileCover:
        """Return the cover of every view: the root of the tree, or no tile of an empty map."""
        return TileCover(tuple(range(len(self.index.tiles)))[-1:], np.inf)

    def cover(self, camera: Camera, T_world_camera: Array, pixel_error: float) -> TileCover:
        """Return the tiles whose Gaussians :meth:`splatbot.tiles.TiledMap.in_view` returns.

        Args:
            camera: pinhole camera.
            T_world_camera: (4, 4) rigid and finite [m].
            pixel_error: largest edge of a cell of merged Gaussians [px].
        """
        visible, depths = self._visible(camera, inverse(T_world_camera))
        errors = max(camera.fx, camera.fy) * np.array([tile.error for tile in self.index.tiles]) / depths
        numbers, reached = self._refined(visible, errors, pixel_error)
        return TileCover(tuple(numbers), reached)

    def tile(self, number: int) -> GaussianModel:
        """Return the Gaussians of a tile.

        Raises:
            FormatError: the tile is damaged.
        """
        return self._load(number).model

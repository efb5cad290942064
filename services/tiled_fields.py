"""Collision fields of tiled maps, whose errors name the fields of a request."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.tiles import TiledField, TiledMap
from splatbot.tiles.tiled_map import TileMemoryError

REACH = 1.0  # [m] farther distances are unknown


def field_around(
    tiles: TiledMap, centres: NDArray[np.float64], name: str, *, room: float = 0.0, n_sigma: float = 2.0
) -> TiledField:
    """Return the field around the box of finite ``centres`` (P, 3) [m], enlarged by ``room`` [m]; requests share it.

    Args:
        tiles: the map.
        centres: without any, the box is at the origin.
        name: field of the request that gives the centres, for errors.
        room: largest radius of spheres [m].
        n_sigma: standard deviations at which the surface of a Gaussian lies.

    Raises:
        InputError: the tiles of the box exceed the memory.
    """
    around = centres if len(centres) else np.zeros((1, 3))
    try:
        return tiles.shared_field(around.min(axis=0) - room, around.max(axis=0) + room, n_sigma, reach=REACH)
    except TileMemoryError as error:
        hint = "send rows that are closer together, or raise SPLATBOT_TILES_MB"
        raise InputError(error.message, field=name, hint=hint) from error

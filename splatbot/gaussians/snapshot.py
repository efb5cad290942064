"""An immutable, numbered state of the map, which any number of readers may hold."""

from __future__ import annotations

from dataclasses import dataclass

from splatbot.gaussians.model import GaussianModel


@dataclass(frozen=True)
class Snapshot:
    """The map at one moment, immutable; the mapper publishes it.

    Args:
        model: the Gaussians; not shared with the mapper.
        map_version: grows by one with each published state.
        stamp: time [s] of the last frame that the map has seen.
    """

    model: GaussianModel
    map_version: int
    stamp: float = 0.0

"""Maps on disk as a tree of tiles: exact Gaussians near a box, and levels of detail for views."""

from splatbot.tiles.field import TiledField
from splatbot.tiles.part import MapPart
from splatbot.tiles.tiled_map import TileCover, TiledMap, TiledView
from splatbot.tiles.writing import write_tiles

__all__ = ["MapPart", "TileCover", "TiledField", "TiledMap", "TiledView", "write_tiles"]

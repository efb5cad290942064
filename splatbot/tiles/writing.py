"""Cuts a map into a tree of tiles and writes it."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import BinaryIO

import numpy as np
import torch

from splatbot.atomic import atomic_write, replace_files, sweep_drafts, write_text
from splatbot.collision.solids import MAX_VALUE
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.layouts import TILES_NAME
from splatbot.protocols import Array
from splatbot.tiles.index import DATA_NAME, MAX_TILES, Tile, TileIndex
from splatbot.tiles.merging import Ints, merged
from splatbot.tiles.part import MapPart, encode
from splatbot.workspace import NAME as SCENE_NAME
from splatbot.workspace import Workspace


@dataclass(frozen=True)
class TilingConstants:
    """Constants of tiling.

    Args:
        tile_gaussians: default of the largest number of Gaussians of a tile.
        least, most: limits of that number.
        quantiles: of the coordinates, between which lies the extent of a part; outliers do not count.
        wide: number of standard deviations at which a wide Gaussian reaches over the edge of a usual tile.
    """

    tile_gaussians: int = 16_384
    least: int = 64
    most: int = 1_000_000
    quantiles: tuple[float, float] = (0.02, 0.98)
    wide: float = 3.0


CONSTANTS = TilingConstants()
_TILES_OF_FULL = 4  # at most, for each full tile of Gaussians: leaves are half full, and have as many parents


def write_tiles(
    model: GaussianModel,
    folder: str | Path,
    *,
    tile_gaussians: int = CONSTANTS.tile_gaussians,
    source: str = "",
    workspace: Workspace | None = None,
) -> TileIndex:
    """Write a map as a folder of tiles, which :class:`splatbot.tiles.TiledMap` reads.

    A part of the map is halved at the median of its longest side until it fits into a tile. Wide Gaussians have a tree
    of their own: they would enlarge the bounds of all others. Each inner tile has the merged Gaussians of its children,
    at half their number.

    Args:
        model: the map.
        folder: it is created if need be; a tiled map in it is replaced, and drafts of killed writers are removed.
        tile_gaussians: largest number of Gaussians of a leaf.
        source: name of the map, for display.
        workspace: scene of the map, written next to the tiles. If None, the folder's own scene stays.

    Raises:
        InputError: a value is not finite or beyond 1e6 m, or tile_gaussians is out of range or small for the map.
        OSError: the folder cannot be written.
    """
    if not CONSTANTS.least <= tile_gaussians <= CONSTANTS.most:
        hint = f"give {CONSTANTS.least} to {CONSTANTS.most:,}"
        raise InputError(f"is {tile_gaussians}.", field="tile_gaussians", hint=hint)
    least = -(-_TILES_OF_FULL * len(model) // (MAX_TILES - 1))
    if tile_gaussians < least:
        problem = f"is {tile_gaussians:,}, too few for a map of {len(model):,}."
        raise InputError(problem, field="tile_gaussians", hint=f"give {least:,} or more")
    model = GaussianModel(**{column.name: getattr(model, column.name).detach() for column in fields(model)})
    _check(model)
    sweep_drafts(Path(folder))
    index = TileIndex(source=source, gaussians=len(model), sh_degree=model.sh_degree, tiles=())

    def write_data(path: Path) -> None:
        nonlocal index
        with atomic_write(path) as file:
            writer = _TileWriter(model, tile_gaussians, file)
            writer.write_all()
        index = index.model_copy(update={"tiles": tuple(writer.tiles)})

    def write_index(path: Path) -> None:
        write_text(index.to_json())(path)

    scene = {} if workspace is None else {SCENE_NAME: workspace.save}
    replace_files(folder, {**scene, DATA_NAME: write_data, TILES_NAME: write_index}, remove=[TILES_NAME])
    return index


@dataclass
class _TileWriter:
    """Writes the tiles of a map, children before their parent."""

    model: GaussianModel
    most: int
    file: BinaryIO
    tiles: list[Tile] = field(default_factory=list)

    def write_all(self) -> None:
        """Write the tree of a map, and its root."""
        if not len(self.model):
            return
        means, scales = self.model.means.numpy(), self.model.scales.amax(1).numpy()
        wide = scales * CONSTANTS.wide > _usual_edge(means, self.most)
        trees = [self._write_tree(np.flatnonzero(rows)) for rows in (~wide, wide) if rows.any()]
        if len(trees) > 1:
            self._write_parent(trees)

    def _write_tree(self, rows: Ints) -> tuple[int, MapPart]:
        """Write the tree of some rows; return the number of its root, and its Gaussians."""
        if len(rows) <= self.most:
            part = MapPart(self.model.select(torch.from_numpy(rows)), torch.from_numpy(rows.astype(np.int32)))
            return self._write(part, (), 0.0), part
        means = self.model.means.numpy()[rows]
        along = means[:, int(np.argmax(_extent(means)))]
        order = np.argpartition(along, len(rows) // 2)
        halves = (np.sort(rows[order[: len(rows) // 2]]), np.sort(rows[order[len(rows) // 2 :]]))
        return self._write_parent([self._write_tree(half) for half in halves])

    def _write_parent(self, trees: list[tuple[int, MapPart]]) -> tuple[int, MapPart]:
        children = tuple(number for number, _ in trees)
        least_edge = max(self.tiles[number].error for number in children)
        together = MapPart.union([part for _, part in trees])
        part, edge = merged(together, max(len(part) for _, part in trees), least_edge)
        return self._write(part, children, edge), part

    def _write(self, part: MapPart, children: tuple[int, ...], error: float) -> int:
        data = encode(part)
        self.file.write(data)
        means, inner = part.model.means, [self.tiles[number] for number in children]
        tile = Tile(
            children=children,
            count=len(part),
            low=tuple(np.min([means.amin(0).tolist(), *(child.low for child in inner)], axis=0).tolist()),
            high=tuple(np.max([means.amax(0).tolist(), *(child.high for child in inner)], axis=0).tolist()),
            scale=max([float(part.model.scales.max()), *(child.scale for child in inner)]),
            error=error,
            sha256=hashlib.sha256(data).hexdigest(),
        )
        self.tiles.append(tile)
        return len(self.tiles) - 1


def _usual_edge(means: Array, most: int) -> float:
    """Return the longest side [m] of a tile of ``most`` Gaussians, if they were spread evenly over the extent."""
    sides, count = _extent(means), len(means)
    while count > most:
        sides[int(np.argmax(sides))] *= 0.5
        count //= 2
    return float(sides.max())


def _extent(means: Array) -> Array:
    low, high = np.quantile(means, CONSTANTS.quantiles, axis=0)
    return np.asarray(high - low, dtype=np.float64)


def _check(model: GaussianModel) -> None:
    """Check that all values are finite, and lengths below 1e6 m.

    Raises:
        InputError: the message names the row.
    """
    for name in ("means", "quats", "log_scales", "opacity_logits", "sh", "uncertainty"):
        bad = ~torch.isfinite(getattr(model, name))[:, None].flatten(1).all(dim=1)
        if bad.any():
            raise InputError(f"row {int(bad.nonzero()[0, 0])} is not finite.", field=name, hint="remove that Gaussian")
    for name, lengths in (("means", model.means.abs()), ("log_scales", model.scales)):
        far = (lengths > MAX_VALUE).any(dim=1)
        if far.any():
            hint = "give metres, or remove that Gaussian"
            raise InputError(f"row {int(far.nonzero()[0, 0])} is beyond {MAX_VALUE:g} m.", field=name, hint=hint)
    zero = (model.quats == 0).all(dim=1)
    if zero.any():
        hint = "use (1, 0, 0, 0) for no rotation"
        raise InputError(f"row {int(zero.nonzero()[0, 0])} is zero.", field="quats", hint=hint)

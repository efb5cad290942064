"""Descriptions of tiled maps."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path

from splatbot.errors import InputError
from splatbot.layouts import TILES_NAME


def check_tiled(is_tiled: bool, *, whole: Mapping[str, object], tiled: Mapping[str, object]) -> None:
    """Refuse options of another kind of map; an option that was not given is None.

    Args:
        is_tiled: whether the map is tiled.
        whole: options that need a whole map.
        tiled: options of tiled maps.

    Raises:
        InputError: an option does not fit.
    """
    if is_tiled:
        needed, hint, unfit = "needs a whole map.", "give the map that the tiled map was made of", whole
    else:
        needed, hint, unfit = "is for a tiled map.", "write one with `splatbot tile`", tiled
    for name, value in unfit.items():
        if value is not None:
            raise InputError(needed, field=name, hint=hint)


def describe_tiles(folder: Path) -> list[tuple[str, str]]:
    """Describe a tiled map as names and values, with a row for each level of detail.

    Raises:
        FormatError: the index is damaged.
    """
    from splatbot.results.units import count, megabytes, metres
    from splatbot.tiles.index import DATA_NAME, read_index

    index = read_index(folder)
    tiles = index.tiles
    stored = sum((folder / name).stat().st_size for name in (DATA_NAME, TILES_NAME))
    rows = [
        ("Gaussians", count(index.gaussians)),
        ("SH degree", str(index.sh_degree)),
        ("map", index.source),
        ("files", megabytes(stored)),
        ("tiles", count(len(tiles))),
    ]
    for k, axis in enumerate("xyz" if tiles else ""):
        low, high = min(tile.low[k] for tile in tiles), max(tile.high[k] for tile in tiles)
        rows.append((f"{axis} [m]", f"{low:.3f} to {high:.3f}"))
    levels = [0] * len(tiles)
    for number in reversed(range(len(tiles))):
        for child in tiles[number].children:
            levels[child] = levels[number] + 1
    for level in range(max(levels, default=-1) + 1):
        here = [tile for tile, own in zip(tiles, levels, strict=True) if own == level]
        edges = [tile.error for tile in here if tile.children]
        limits = dict.fromkeys(metres(edge) for edge in (min(edges), max(edges))) if edges else ()
        cells = f"cells of {' to '.join(limits)}" if edges else "exact"
        size = f"{count(sum(t.count for t in here))} Gaussians, {len(here)} tile{'s' if len(here) > 1 else ''}"
        rows.append((f"level {level}", f"{size}, {cells}"))
    return rows

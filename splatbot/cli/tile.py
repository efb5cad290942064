"""`splatbot tile`."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from math import inf
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from splatbot.cli.paths import check_new, check_output
from splatbot.errors import InputError
from splatbot.layouts import TILES_NAME, is_map, log_layout, map_file

if TYPE_CHECKING:
    from splatbot.gaussians import GaussianModel
    from splatbot.tiles.sweep import SweepView

_VIEWS = 6  # of a sweep


def tile(
    map: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|MAP")],
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="FOLDER")],
    tile_gaussians: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    sweep: bool = False,
    memory_mb: Annotated[float | None, tyro.conf.arg(metavar="MB")] = None,
    overwrite: bool = False,
) -> int:
    """Write a map as a folder of tiles, of which a program loads only those that it needs.

    Collision queries in a box have the answers of the whole map. Views use coarser tiles where details are below a
    pixel. `splatbot render`, `view`, `info` and `serve` take the folder, and a copy of the map's scene.yaml is in it.

    The sweep compares the tiled map with the whole one. References are the held-out images of the run, or the whole map
    with 16 rays a pixel from 6 virtual views.

    Examples:
        splatbot tile runs/building --out building-tiles
        splatbot tile scene.ply --out scene-tiles --sweep
        splatbot render building-tiles --pose 0 0 -1.5 1 0 0 0

    Args:
        map: the folder of a run, or a map file; it is loaded as a whole once.
        out: folder to write.
        tile_gaussians: largest number of Gaussians of a tile; by default 16,384.
        sweep: then print accuracy, memory and time of views and queries.
        memory_mb: with --sweep, memory of tiles [MB]; by default 24.
        overwrite: replace the tiled map that --out names.
    """
    file = map_file(map)
    check_output(out)
    if is_map(out) or log_layout(out) or (out / "metrics.json").exists():
        hint = "name a folder of its own"
        raise InputError("is the folder of a run, a map or a log.", file=out, field="--out", hint=hint)
    if (out / TILES_NAME).exists():
        check_new(out, overwrite=overwrite)
    if memory_mb is not None and not sweep:
        raise InputError("goes with --sweep.", field="--memory-mb", hint="give both, or leave it out")
    if memory_mb is not None and not 0.0 < memory_mb < inf:
        raise InputError(f"is {memory_mb:g}.", field="--memory-mb", hint="give megabytes, above 0")

    from splatbot.cli.progress import steps
    from splatbot.cli.tables import print_command, print_table
    from splatbot.cli.tiled import describe_tiles
    from splatbot.formats import load_gaussians
    from splatbot.tiles.tiled_map import CONSTANTS
    from splatbot.tiles.writing import CONSTANTS as TILING
    from splatbot.tiles.writing import write_tiles
    from splatbot.workspace import find_workspace

    scene = find_workspace(file)
    count = TILING.tile_gaussians if tile_gaussians is None else tile_gaussians
    if not TILING.least <= count <= TILING.most:
        hint = f"give {TILING.least} to {TILING.most:,}"
        raise InputError(f"is {count:,}.", field="--tile-gaussians", hint=hint)
    with steps() as on_step, _named_as_flags():
        on_step("loading")
        model = load_gaussians(file)
        on_step("tiling")
        write_tiles(model, out, tile_gaussians=count, source=file.name, workspace=scene)
    print_table(describe_tiles(out), title=str(out))
    if sweep and len(model):
        _sweep(model, map, out, CONSTANTS.memory_mb if memory_mb is None else memory_mb)
    print_command(f"splatbot render {out}")
    return 0


@contextmanager
def _named_as_flags() -> Iterator[None]:
    """Name the flag in errors of a value that fits no tile of this map."""
    try:
        yield
    except InputError as error:
        if error.field not in ("tile_gaussians", "memory_mb"):
            raise
        flag = f"--{error.field.replace('_', '-')}"
        raise InputError(error.message, file=error.file, field=flag, hint=error.hint) from error


def _sweep(model: GaussianModel, map_: Path, folder: Path, memory_mb: float) -> None:
    """Print the scores of views and queries."""
    from rich.table import Table

    from splatbot.cli.progress import steps
    from splatbot.cli.tables import print_columns, print_table
    from splatbot.results.units import count, milliseconds
    from splatbot.tiles import TiledMap
    from splatbot.tiles.sweep import CONSTANTS, score_queries, score_views

    with _named_as_flags(), TiledMap(folder, memory_mb=memory_mb) as tiles, steps() as on_step:
        on_step("reference images")
        views, source = _views(model, map_)
        on_step("views")
        scores = list(score_views(model, tiles, views))
        on_step("queries")
        queries = score_queries(model, folder, memory_mb=memory_mb)
    table = Table("pixel error", "reached", "Gaussians", "load", "render", "PSNR", "least gain on the whole map")
    for score in scores:
        table.add_row(
            f"{score.pixel_error:g} px",
            f"{score.reached:.2f} px",
            count(score.gaussians),
            milliseconds(score.load_ms),
            milliseconds(score.render_ms),
            f"{score.psnr_db:.2f} dB",
            f"{score.least_gain_db:+.2f} dB",
        )
    print(f"{len(views)} views with {memory_mb:g} MB, against {source}")
    print_columns(table)
    rows = [
        ("open the map", milliseconds(queries.open_ms)),
        ("load the field of a box", milliseconds(queries.field_ms)),
        ("check the first sphere", milliseconds(queries.query_ms)),
        ("Gaussians of the field", f"at most {count(queries.gaussians)}"),
        ("spheres, hits", f"{count(queries.spheres)}, {count(queries.hits)}"),
        ("verdicts unlike the whole map's", count(queries.different)),
    ]
    title = f"collision queries in boxes of {CONSTANTS.box:g} m, each after a cold start; median times"
    print_table(rows, title=title)


def _views(model: GaussianModel, map_: Path) -> tuple[list[SweepView], str]:
    """Return held-out views with their images, or virtual views of the whole map with many rays a pixel."""
    import torch

    from splatbot.cli.map_views import recorded_views
    from splatbot.spacing import evenly_spaced
    from splatbot.tiles.sweep import CONSTANTS, SweepView, supersampled
    from splatbot.training.images import ImageCache
    from splatbot.training.map_views import around

    recorded = recorded_views(map_)
    if recorded is None or not recorded.held_out:
        source = f"the whole map with {CONSTANTS.supersampling**2} rays a pixel"
        return [supersampled(model, *view) for view in around(model, _VIEWS)], source
    chosen = evenly_spaced(recorded.held_out, _VIEWS)
    photos, black = ImageCache(chosen), torch.zeros(3)
    images = [photos.photo(number).over(black).numpy() for number in range(len(chosen))]
    views = [SweepView(v.camera, v.T_world_camera, image) for v, image in zip(chosen, images, strict=True)]
    return views, f"images of {recorded.recording}"

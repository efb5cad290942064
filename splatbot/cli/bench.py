"""`splatbot bench`."""

from __future__ import annotations

import sys
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import tyro

if TYPE_CHECKING:
    from rich.table import Table

    from splatbot.bench.results import Results, Row

_TIMES = ("forward", "forward+backward", "forward+pose backward")
_FILE_WIDTH = 160  # [characters] where there is no terminal to ask
_SHARES = ("blend forward, share of FMA peak", "blend backward, share of FMA peak")


def bench(
    name: Annotated[Literal["raster", "collision"], tyro.conf.Positional, tyro.conf.arg(metavar="NAME")],
    /,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    peers: bool = False,
    splat: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    threads: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")] = (1, 2),
    run: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    quick: bool = False,
) -> int:
    """Measure speed, and what accuracy costs in time.

    raster: the rasterizer, forward and backward, on built-in scenes from 320x240 to 1280x720; its share of this
    machine's peak of multiply-adds; the fused loss; what each option costs; error against milliseconds; growth.
    Times are the least of several runs (with the median beside), in milliseconds, through Python and autograd.

    collision: the collision field and an arm of spheres: build, update, memory, questions a second; false free and
    false hit against exact truth, over n_sigma and over how edges are checked; what floaters block.

    Examples:
        splatbot bench raster
        splatbot bench raster --peers
        splatbot bench raster --splat runs/latest/map.ply --threads 1 2 4
        splatbot bench raster --quick --json figures.json
        splatbot bench collision --peers

    Args:
        name: what to measure.
        out: folder for NAME.json, NAME.csv and the plots; by default runs/bench-NAME.
        json: another place for the JSON file.
        peers: measure other implementations of the same model beside it (minutes).
        splat: a map or splat file to render as well (raster).
        threads: how many threads to measure with.
        run: a run folder of splatbot map, whose field is compared with its log's raw depth (collision).
        quick: tiny scenes, to see whether it runs.
    """
    from splatbot.errors import InputError

    if not threads or min(threads) < 1:
        raise InputError(f"is {threads}.", field="--threads", hint="give one or more positive numbers, as in 1 2")

    from dataclasses import replace

    from rich.console import Console

    folder = out if out is not None else Path("runs") / f"bench-{name}"
    progress = Console(stderr=True)

    def say(text: str) -> None:
        progress.print(f"[dim]{text} ...[/dim]", highlight=False)

    if name == "collision":
        from splatbot.bench.collision import CollisionPlan, run_collision
        from splatbot.cli.bench_collision import print_collision

        field_plan = CollisionPlan.quick_plan(say=say) if quick else CollisionPlan(say=say)
        found = run_collision(replace(field_plan, thread_counts=tuple(threads), peers=peers, run=run), folder)
        if json is not None:
            found.write_json(json)
        print_collision(found, folder)
        return 0

    from splatbot.bench.raster import RasterPlan, run_raster

    plan = RasterPlan.quick_plan(say=say) if quick else RasterPlan(say=say)
    results = run_raster(replace(plan, thread_counts=tuple(threads), peers=peers, splat=splat), folder)
    if json is not None:
        results.write_json(json)
    _print(results, folder)
    return 0


def _print(results: Results, folder: Path) -> None:
    from rich.console import Console

    console = Console(width=None if sys.stdout.isatty() else _FILE_WIDTH)
    machine = results.machine
    peaks = ", ".join(
        f"{gflops:.0f} GFLOP/s on {n}" for n, gflops in machine["fma_peak_gflops"][machine["isa"]].items()
    )
    console.print(f"{machine['cpu']}, {machine['cpus']} CPUs, kernels {machine['isa']}, peak {peaks} threads")
    if machine["load_1min"] is not None and machine["load_1min"] > 0.5:
        console.print(f"[yellow]the machine was busy (load {machine['load_1min']}): times are upper bounds[/yellow]")
    prefixes = ("effect", "sweep", "growth")
    own = [r for r in results.rows if r.peer is None and not r.case.startswith(prefixes)]
    console.print(_table("Milliseconds, least (median)", own, (*_TIMES, "state memory", "peak memory", *_SHARES)))
    off, on = ("forward, off", "forward+backward, off"), ("forward, on minus off", "forward+backward, on minus off")
    console.print(_table("What an option costs", results.select("effect"), (*off, *on)))
    console.print(_table("Accuracy against time", results.select("sweep"), ("forward", "largest error", "PSNR")))
    growth = (
        "forward+backward",
        "stages over Gaussians",
        "stages over pixels",
        "pairs per pixel",
        "one Gaussian",
        "one evaluated pair",
    )
    console.print(_table("Growth", results.select("growth"), growth))
    for row in results.select("growth"):
        if row.unit == "x":
            console.print(f"{row.case}: {row.metric} {_figure(row)}")
    peers = [row for row in results.rows if row.peer is not None]
    if peers:
        ratios = ("forward, times ours", "forward+backward, times ours")
        errors = ("image, error of 99.9 % of the pixels", "gradients, largest relative difference")
        console.print(_table("Peers, in the same process", peers, (*_TIMES[:2], *ratios, *errors)))
        for row in {row.peer: row for row in peers if row.metric == "what it is"}.values():
            console.print(f"{row.peer}: {row.note}")
    console.print(f"written to {folder}")


def _table(title: str, rows: Iterable[Row], metrics: Sequence[str]) -> Table:
    """A line per case and peer, a column per metric; a case without figures shows why."""
    from rich.table import Table

    table = Table(title=title)
    grouped: dict[str, dict[str, Row]] = {}
    for row in rows:
        grouped.setdefault(f"{row.case}: {row.peer}" if row.peer else row.case, {})[row.metric] = row
    table.add_column("case")
    for metric in metrics:
        table.add_column(metric, justify="right")
    for case, found in grouped.items():
        cells = [_figure(found[metric]) if metric in found else "" for metric in metrics]
        if any(cells):
            table.add_row(case, *cells)
    return table


def _figure(row: Row) -> str:
    if row.value is None:
        return row.note or "-"
    median = f" ({row.value + row.spread:.2f})" if row.spread is not None else ""
    digits = f"{row.value:.2f}" if row.unit == "ms" else f"{row.value:.3g}"
    return f"{digits}{median}" if row.unit == "ms" else f"{digits} {row.unit}".rstrip()

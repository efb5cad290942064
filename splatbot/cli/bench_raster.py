"""`splatbot bench raster`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from splatbot.bench.results import Results

_TIMES = ("forward", "forward+backward", "forward+pose backward")
_SHARES = ("blend forward, share of FMA peak", "blend backward, share of FMA peak")


def bench_raster(
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    peers: bool = False,
    splat: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    threads: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")] = (1, 2),
    quick: bool = False,
    variants: bool = False,
) -> int:
    """Measure the rasterizer's speed, and what accuracy costs it in time.

    Forward and backward, on built-in scenes from 320x240 to 1280x720; its share of this machine's peak of
    multiply-adds; the fused loss; what each option costs; error against milliseconds; growth. Times are the least of
    several runs (with the median beside), in milliseconds, through Python and autograd.

    Examples:
        splatbot bench raster
        splatbot bench raster --peers
        splatbot bench raster --splat runs/latest/map.ply --threads 1 2 4
        splatbot bench raster --variants
        splatbot bench raster --quick --json figures.json

    Args:
        out: folder for raster.json, raster.csv and the plots; by default runs/bench-raster.
        json: another place for the JSON file.
        peers: measure other implementations of the same model beside it (minutes).
        splat: a map or splat file to render as well.
        threads: how many threads to measure with.
        quick: tiny scenes, to see whether it runs.
        variants: compile the C++ core with other constants (exponential, tiles) and measure that too (ten minutes).
    """
    from splatbot.errors import InputError

    if not threads or min(threads) < 1:
        raise InputError(f"is {threads}.", field="--threads", hint="give one or more positive numbers, as in 1 2")

    from dataclasses import replace

    from splatbot.bench.raster import RasterPlan, run_raster
    from splatbot.cli.bench_tables import say_progress

    folder = out if out is not None else Path("runs") / "bench-raster"
    plan = RasterPlan.quick_plan(say=say_progress) if quick else RasterPlan(say=say_progress)
    results = run_raster(
        replace(plan, thread_counts=tuple(threads), peers=peers, splat=splat, variants=variants), folder
    )
    if json is not None:
        results.write_json(json)
    _print(results, folder)
    return 0


def _print(results: Results, folder: Path) -> None:
    from splatbot.cli.bench_tables import figure_table, figure_text, tell_machine, wide_console

    console = wide_console()
    machine = results.machine
    peaks = ", ".join(
        f"{gflops:.0f} GFLOP/s on {n}" for n, gflops in machine["fma_peak_gflops"][machine["isa"]].items()
    )
    tell_machine(console, machine, f"peak {peaks} threads")
    prefixes = ("effect", "sweep", "growth")
    own = [r for r in results.rows if r.peer is None and not r.case.startswith(prefixes)]
    console.print(figure_table("Milliseconds, least (median)", own, (*_TIMES, "state memory", "peak memory", *_SHARES)))
    off, on = ("forward, off", "forward+backward, off"), ("forward, on minus off", "forward+backward, on minus off")
    console.print(figure_table("What an option costs", results.select("effect"), (*off, *on)))
    console.print(figure_table("Accuracy against time", results.select("sweep"), ("forward", "largest error", "PSNR")))
    growth = (
        "forward+backward",
        "stages over Gaussians",
        "stages over pixels",
        "pairs per pixel",
        "one Gaussian",
        "one evaluated pair",
    )
    console.print(figure_table("Growth", results.select("growth"), growth))
    for row in results.select("growth"):
        if row.unit == "x":
            console.print(f"{row.case}: {row.metric} {figure_text(row)}")
    peers = [row for row in results.rows if row.peer is not None]
    if peers:
        ratios = ("forward, times ours", "forward+backward, times ours")
        errors = ("image, error of 99.9 % of the pixels", "gradients, largest relative difference")
        console.print(figure_table("Peers, in the same process", peers, (*_TIMES[:2], *ratios, *errors)))
        for row in {row.peer: row for row in peers if row.metric == "what it is"}.values():
            console.print(f"{row.peer}: {row.note}")
    console.print(f"written to {folder}")

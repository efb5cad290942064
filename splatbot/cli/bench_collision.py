"""`splatbot bench collision`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from splatbot.bench.results import Results


def bench_collision(
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    peers: bool = False,
    threads: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")] = (1, 2),
    run: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    quick: bool = False,
) -> int:
    """Measure the collision field and an arm of spheres in it.

    Build, update, memory, questions a second; false free and false hit against exact truth, over n_sigma and over how
    edges are checked; what floaters block.

    Examples:
        splatbot bench collision
        splatbot bench collision --peers
        splatbot bench collision --run runs/latest
        splatbot bench collision --quick --json figures.json

    Args:
        out: folder for collision.json, collision.csv and the plots; by default runs/bench-collision.
        json: another place for the JSON file.
        peers: measure other ways to ask for collisions beside it (minutes).
        threads: how many threads to measure with.
        run: a run folder of splatbot map, whose field is compared with its log's raw depth.
        quick: tiny scenes, to see whether it runs.
    """
    from splatbot.errors import InputError

    if not threads or min(threads) < 1:
        raise InputError(f"is {threads}.", field="--threads", hint="give one or more positive numbers, as in 1 2")

    from dataclasses import replace

    from splatbot.bench.collision import CollisionPlan, run_collision
    from splatbot.cli.bench_tables import say_progress

    folder = out if out is not None else Path("runs") / "bench-collision"
    plan = CollisionPlan.quick_plan(say=say_progress) if quick else CollisionPlan(say=say_progress)
    results = run_collision(replace(plan, thread_counts=tuple(threads), peers=peers, run=run), folder)
    if json is not None:
        results.write_json(json)
    _print(results, folder)
    return 0


def _print(results: Results, folder: Path) -> None:
    """A table of speed with a column per case, one of errors with a line per case, and the peers."""
    from rich.table import Table

    from splatbot.cli.bench_tables import figure_table, figure_text, metric_table, tell_machine, wide_console

    console = wide_console()
    tell_machine(console, results.machine)
    own = [row for row in results.rows if row.peer is None]
    console.print(metric_table("Speed and memory", [row for row in own if " Gaussians, " in row.case]))
    for title, prefix in (
        ("Configurations against exact truth", "sweep n_sigma"),
        ("Packed, against exact truth", "sweep storage"),
        ("Edges against exact truth", "sweep edges"),
        ("Floaters", "gate"),
    ):
        console.print(figure_table(title, results.select(prefix)))
    maps = [row for row in own if row.case.startswith("mapped") or row.case.endswith("points in free space")]
    console.print(metric_table("Maps made from images", maps))
    rest = [row for row in results.rows if row.case.startswith(("points against", "configurations, "))]
    if rest:
        table = Table("case", "metric", "whose", "figure", title="Beside peers")
        for row in rest:
            table.add_row(row.case, row.metric, row.peer or "splatbot", figure_text(row))
        console.print(table)
    console.print(f"written to {folder}")

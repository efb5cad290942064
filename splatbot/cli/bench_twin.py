"""`splatbot bench twin`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from splatbot.cli.drawing import draw_offscreen


def bench_twin(
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    paths: Annotated[int, tyro.conf.arg(metavar="N")] = 200,
    scene: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME"), tyro.conf.UseAppendAction] = (),
    quick: bool = False,
) -> int:
    """Measure the twin.

    What a step costs with and without a map's clutter, awake and asleep; what each effect costs, alone and together;
    error against the time step; planned paths among the true shapes, and paths pushed into an obstacle; the picture of
    a robot among Gaussians against that of the true shapes. Exit code 1: a figure is out of its bounds.

    Examples:
        splatbot bench twin
        splatbot bench twin --paths 20 --scene wiping
        splatbot bench twin --quick --json figures.json

    Args:
        out: folder for twin.json and twin.csv; by default runs/bench-twin.
        json: another place for the JSON file.
        paths: how many to plan and follow.
        scene: whose effects are measured; once for each, all that are shipped by default.
        quick: tiny, to see whether it runs.
    """
    from splatbot.errors import InputError

    if paths < 1:
        raise InputError(f"is {paths}.", field="--paths", hint="give a positive number")

    draw_offscreen()
    from splatbot.bench.twin import TwinPlan, run_twin
    from splatbot.bench.twin_bounds import broken_bounds
    from splatbot.cli.bench_tables import say_progress, tell_machine, wide_console

    folder = out if out is not None else Path("runs") / "bench-twin"
    plan = TwinPlan(paths=paths, scenes=tuple(scene), say=say_progress)
    if quick:
        plan = TwinPlan(90, 2, 50.0, 4000, (0.004, 0.008), tuple(scene) or ("wiping",), 2, True, say_progress)
    results = run_twin(plan, folder)
    if json is not None:
        results.write_json(json)
    console = wide_console()
    tell_machine(console, results.machine)
    from rich.table import Table

    table = Table("case", "metric", "figure", "")
    for row in results.rows:
        figure = "-" if row.value is None else f"{row.value:.4g} {row.unit}".rstrip()
        table.add_row(row.case, row.metric, figure, row.note or "")
    console.print(table)
    console.print(f"written to {folder}")
    broken = broken_bounds(results) if not quick else []
    for text in broken:
        console.print(f"[red]{text}[/red]")
    return 1 if broken else 0

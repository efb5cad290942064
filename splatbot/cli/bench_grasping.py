"""`splatbot bench grasping`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro


def bench_grasping(
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    gaussians: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")] = (50_000, 10_000, 150_000),
    samples: Annotated[tuple[int, ...], tyro.conf.arg(metavar="N ...")] = (50, 100, 200, 400, 800, 1600),
    quick: bool = False,
) -> int:
    """Measure grasping on a table top of exact shapes.

    Candidates a second and milliseconds to a ranked list, arm included, over sizes of the map and over samples, the
    knob of time; how far contacts are from the true surfaces, and how far the line between them from the true normals.

    Examples:
        splatbot bench grasping
        splatbot bench grasping --gaussians 150000 --samples 400 3200
        splatbot bench grasping --quick --json figures.json

    Args:
        out: folder for grasping.json and grasping.csv; by default runs/bench-grasping.
        json: another place for the JSON file.
        gaussians: sizes of the maps; samples are swept on the first.
        samples: seeds on the surface of a thing.
        quick: a small map, to see whether it runs.
    """
    from splatbot.errors import InputError

    if not gaussians or min((*gaussians, *samples)) < 1:
        raise InputError("has a number below 1.", field="--gaussians, --samples", hint="give positive numbers")

    from splatbot.bench.grasping import GraspingPlan, run_grasping
    from splatbot.cli.bench_tables import metric_table, say_progress, tell_machine, wide_console

    folder = out if out is not None else Path("runs") / "bench-grasping"
    plan = (
        GraspingPlan.quick_plan(say=say_progress)
        if quick
        else GraspingPlan(tuple(gaussians), tuple(samples), say=say_progress)
    )
    results = run_grasping(plan, folder)
    if json is not None:
        results.write_json(json)
    console = wide_console()
    tell_machine(console, results.machine)
    for title, part in (("By size of the map", "Gaussians"), ("By samples", "samples")):
        rows = [row for row in results.rows if part in row.case]
        if rows:
            console.print(metric_table(title, rows))
    console.print(f"written to {folder}")
    return 0

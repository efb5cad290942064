"""`splatbot bench service`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro


def bench_service(
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    clients: Annotated[int, tyro.conf.arg(metavar="N")] = 50,
    per_s: Annotated[float, tyro.conf.arg(metavar="HZ")] = 2.0,
    seconds: Annotated[float, tyro.conf.arg(metavar="S")] = 60.0,
    rate: Annotated[float, tyro.conf.arg(metavar="HZ")] = 5.0,
    quick: bool = False,
) -> int:
    """Measure the service.

    Frames are pushed at a camera's pace and mapped, first without questions, then while clients ask for the distance
    of 1,000 points each at fixed times; and what HTTP adds to a question of 100,000 points.

    Examples:
        splatbot bench service
        splatbot bench service --clients 10 --seconds 20
        splatbot bench service --quick --json figures.json

    Args:
        out: folder for service.json, service.csv and the service's log; by default runs/bench-service.
        json: another place for the JSON file.
        clients: that ask.
        per_s: questions of each a second.
        seconds: of each part.
        rate: frames a second.
        quick: tiny, to see whether it runs.
    """
    from splatbot.errors import InputError

    for name, value in (("--clients", clients), ("--per-s", per_s), ("--seconds", seconds), ("--rate", rate)):
        if not value > 0:
            raise InputError(f"is {value}.", field=name, hint="give a positive number")

    from splatbot.bench.service import ServicePlan, run_service_bench
    from splatbot.cli.bench_tables import figure_table, say_progress, tell_machine, wide_console

    folder = out if out is not None else Path("runs") / "bench-service"
    plan = ServicePlan(rate=rate, clients=clients, per_s=per_s, seconds=seconds, say=say_progress)
    if quick:
        small = "synthetic:tabletop?frames=6&width=160&height=120&arc=4"
        plan = ServicePlan(small, 10.0, 3, 2.0, 100, 2.0, 1000, say_progress)
    results = run_service_bench(plan, folder)
    if json is not None:
        results.write_json(json)
    console = wide_console()
    tell_machine(console, results.machine)
    parts = {"frames mapped": ["frames", "frame p50", "frame p95", "frame p95 grows by", "dropped"]}
    parts["frames, from the push to the answer"] = [f"pushed and answered p{share}" for share in (50, 95)]
    parts["questions"] = ["questions", "errors", *(f"answer p{share}" for share in (50, 95, 99, 100))]
    parts["processor time"] = ["service's processors", "clients' processors", "service's processors for an answer"]
    rest = [row for row in results.rows if row.metric not in {name for names in parts.values() for name in names}]
    for title, metrics in parts.items():
        console.print(figure_table(title, (row for row in results.rows if row.metric in metrics), metrics))
    console.print(figure_table("one large question, and the service's memory", rest))
    console.print(f"written to {folder}")
    return 0

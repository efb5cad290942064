"""`splatbot bench planning`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from splatbot.bench.results import Results


def bench_planning(
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    peers: bool = False,
    budgets: Annotated[tuple[float, ...], tyro.conf.arg(metavar="MS ...")] = (1.0, 3.0, 10.0, 28.0, 100.0, 1000.0),
    problems: int = 50,
    seeds: int = 10,
    mapped: bool = False,
    run: Annotated[tuple[Path, ...], tyro.conf.arg(metavar="DIR ...")] = (),
    quick: bool = False,
) -> int:
    """Measure the planner on a table top of exact shapes.

    Solved problems, milliseconds, cost and clearance over time budgets; what of the paths touches the true shapes;
    how long a path takes to be certified again or repaired when the map changes. With --mapped or --run: the same
    problems on a map of a noisy film of the table top, over margins; others in the maps of recordings.

    Examples:
        splatbot bench planning
        splatbot bench planning --peers
        splatbot bench planning --budgets 10 10000 --problems 10
        splatbot bench planning --mapped --run runs/desk runs/kitchen
        splatbot bench planning --quick --json figures.json

    Args:
        out: folder for planning.json, planning.csv and the plot (planning-mapped.json and .csv with --mapped or --run);
            by default runs/bench-planning.
        json: another place for the JSON file.
        peers: measure other planners and maps beside it (minutes).
        budgets: of the planner [ms].
        problems: how many.
        seeds: of each problem, for budgets up to 100 ms.
        mapped: in place of all that, the map that SLAM makes of a noisy film of the table top (minutes).
        run: in place of all that or with --mapped, run folders of splatbot map: ten problems in each one's map, the arm
            where its scene.yaml says.
        quick: a small map and few problems, to see whether it runs.
    """
    from splatbot.errors import InputError

    if peers and (mapped or run):
        raise InputError("has no part with --mapped or --run.", field="--peers", hint="run it by itself")
    if not budgets or not min(budgets) > 0 or problems < 1 or seeds < 1:
        raise InputError(
            "is empty or has a number that is not above 0.",
            field="--budgets, --problems, --seeds",
            hint="give positive numbers",
        )

    from splatbot.bench.planning import PlanningPlan, run_mapped, run_planning
    from splatbot.cli.bench_tables import say_progress

    folder = out if out is not None else Path("runs") / "bench-planning"
    plan = (
        PlanningPlan.quick_plan(peers=peers, say=say_progress)
        if quick
        else PlanningPlan(problems=problems, seeds=seeds, budgets_ms=tuple(budgets), peers=peers, say=say_progress)
    )
    on_maps = mapped or bool(run)
    results = run_mapped(plan, folder, noisy=mapped, runs=run) if on_maps else run_planning(plan, folder)
    if json is not None:
        results.write_json(json)
    _print(results, folder)
    return 0


def _print(results: Results, folder: Path) -> None:
    from dataclasses import replace

    from splatbot.cli.bench_tables import figure_table, metric_table, tell_machine, wide_console

    console = wide_console()
    tell_machine(console, results.machine)
    own = [row for row in results.rows if row.peer is None]
    if not any(row.case.startswith("budget") for row in own):
        for name in dict.fromkeys(row.case.split(", margin")[0] for row in own):
            group = [row for row in own if row.case.split(", margin")[0] == name]
            console.print(metric_table(name, [replace(row, case=row.case.removeprefix(f"{name}, ")) for row in group]))
        console.print(f"written to {folder}")
        return
    console.print(metric_table("By time budget", [row for row in own if row.case.startswith("budget")]))
    console.print(metric_table("Otherwise", [row for row in own if not row.case.startswith("budget")]))
    for title, part in (("Peers", False), ("Costs as parts of a peer's", True)):
        rows = [row for row in results.rows if row.peer is not None and ("against" in row.case) == part]
        if rows:
            console.print(figure_table(title, rows))
    console.print(f"written to {folder}")

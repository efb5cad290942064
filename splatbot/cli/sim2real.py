"""`splatbot sim2real`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from splatbot.cli.paths import check_output, check_run
from splatbot.cli.placing import named_robot
from splatbot.errors import InputError
from splatbot.layouts import log_kind

if TYPE_CHECKING:
    from splatbot.bench.sim2sim import SimToSimPlan
    from splatbot.robots.robot import RobotModel

Tell = Callable[[str, float], None]


def sim2real(
    log: Annotated[str | None, tyro.conf.Positional, tyro.conf.arg(metavar="LOG")] = None,
    map: Annotated[Path | None, tyro.conf.arg(metavar="RUN")] = None,
    robot: str = "panda",
    frames: Annotated[int, tyro.conf.arg(metavar="N")] = 0,
    held_out: bool = False,
    task: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME"), tyro.conf.UseAppendAction] = (),
    tables: Annotated[int, tyro.conf.arg(metavar="N")] = 2,
    trials: Annotated[int, tyro.conf.arg(metavar="N")] = 10,
    seed: Annotated[int, tyro.conf.arg(metavar="N")] = 0,
    quick: bool = False,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    quiet: bool = False,
) -> int:
    """Measure the difference of the twin from a recorded log, and from a held-out twin.

    Sim-to-real compares colour, depth and silhouettes of the twin at the recorded camera poses of a log. The twin's arm
    repeats the motion of the arm. The arm's poses are those of the log's ee_poses.txt and ee_T_camera, or of its
    joints.txt and the mount in scene.yaml. Writes sim2real.json and sim2real.html.

    Sim-to-sim, with --held-out, runs policies that use only the map of a noisy film. They run in the twin of that map
    and in a held-out twin of the true shapes. The held-out twin has other friction, masses, gains and delays and all
    effects. The report gives success in both, the drop, Pearson's r and the mean maximum rank violation. It compares
    certified and measured clearance. Writes sim2sim.json and sim2sim.html.

    Examples:
        splatbot sim2real /data/arm --map runs/arm
        splatbot sim2real /data/arm --map runs/arm --frames 12 --out runs/arm-twin
        splatbot sim2real --held-out
        splatbot sim2real --held-out --task reach --tables 1 --trials 20

    Args:
        log: a recording that was mapped.
        map: the folder of the run that mapped it.
        robot: the twin's arm. If its joints differ from those of the log, it follows the poses of the tool.
        frames: number of evenly spaced frames to compare; 0 compares all.
        held_out: compare the map's twin with a held-out one, on synthetic tables.
        task: reach or push; repeat it for both. By default both.
        tables: number of different tables, each filmed and mapped.
        trials: number of trials of each task on each table.
        seed: seed of tables, problems and physics.
        quick: two trials of each task on a table filmed briefly, to see whether it runs.
        out: folder to write to; by default runs/sim2real.
        json: path of the JSON file of the log, or without a log of the held-out twin.
        quiet: print only errors.
    """
    if (log is None) != (map is None) or (log is None and not held_out):
        raise InputError("are needed, both.", field="LOG, --map", hint="splatbot sim2real LOG --map RUN, or --held-out")
    if log is not None and map is not None:
        log_kind(log)
        check_run(map)
    arm = named_robot(robot)
    check_output(out)
    check_output(json, "--json", folder=False)

    from splatbot.cli.progress import shares

    folder = out if out is not None else Path("runs") / "sim2real"
    interrupted = False
    with shares(quiet) as tell:
        if log is not None and map is not None:
            interrupted = _compare_log(log, map, arm, frames, folder, json, tell, quiet)
            json = None
        if held_out and not interrupted:
            plan = _plan(task, tables, trials, seed, quick)
            interrupted = _compare_twins(plan, folder, json, tell, quiet)
    if not quiet:
        print(f"written to {folder}")
    return 130 if interrupted else 0


def _compare_log(
    log: str, map: Path, robot: RobotModel, frames: int, folder: Path, json: Path | None, tell: Tell, quiet: bool
) -> bool:
    """Compare, and return whether it was interrupted."""
    from splatbot.cli.tables import print_table
    from splatbot.results.folder import RunFolder
    from splatbot.robots.in_view import reopen_log
    from splatbot.sim.compare.log_twin import KIND, compare_log
    from splatbot.sim.compare.page import log_html, log_rows

    run = RunFolder(map)
    found = compare_log(reopen_log(run, uri=log), run, robot, frames=frames, on_progress=tell)
    _write(folder, "sim2real", json, found.to_dict(), log_html(found))
    if not quiet:
        print_table(log_rows(found), title=f"{KIND}: {found.log} against the twin of {found.map}")
    return found.interrupted


def _plan(task: tuple[str, ...], tables: int, trials: int, seed: int, quick: bool) -> SimToSimPlan:
    from splatbot.bench.sim2sim import TASKS, SimToSimPlan

    unknown = [name for name in task if name not in TASKS]
    if unknown:
        raise InputError(f"there is no {unknown[0]!r}.", field="--task", hint=f"tasks: {', '.join(TASKS)}")
    if min(tables, trials) < 1:
        raise InputError("are below 1.", field="--tables, --trials", hint="give positive numbers")
    if quick:
        return SimToSimPlan(task or TASKS, 1, 2, (24, 160), 4000, seed)
    return SimToSimPlan(task or TASKS, tables, trials, seed=seed)


def _compare_twins(plan: SimToSimPlan, folder: Path, json: Path | None, tell: Tell, quiet: bool) -> bool:
    """Compare, and return whether it was interrupted."""
    from rich.table import Table

    from splatbot.bench.sim2sim import run_sim_to_sim
    from splatbot.cli.tables import print_columns, wide_console
    from splatbot.sim.compare.page import (
        POLICY_HEAD,
        PROMISE_HEAD,
        policy_rows,
        promise_rows,
        trials_html,
        trials_title,
    )
    from splatbot.sim.compare.trials import KIND

    results = run_sim_to_sim(plan, folder, tell)
    interrupted = not results or any(found.interrupted for found in results)
    values = {"kind": KIND, "interrupted": interrupted, "tasks": [found.to_dict() for found in results]}
    _write(folder, "sim2sim", json, values, trials_html(results))
    if quiet:
        return interrupted
    console = wide_console()
    for found in results:
        for title, head, rows in (
            (trials_title(found), POLICY_HEAD, policy_rows(found)),
            (f"{KIND}: certified clearance, {found.task}", PROMISE_HEAD, promise_rows(found)),
        ):
            if rows:
                table = Table(*head, title=title)
                for row in rows:
                    table.add_row(*row)
                print_columns(table, console)
    return interrupted


def _write(folder: Path, name: str, json: Path | None, values: dict[str, Any], page: str) -> None:
    import json as text

    from splatbot.atomic import atomic_write

    for path, content in (
        (json if json is not None else folder / f"{name}.json", text.dumps(values, indent=1, allow_nan=False) + "\n"),
        (folder / f"{name}.html", page),
    ):
        with atomic_write(path) as file:
            file.write(content.encode())

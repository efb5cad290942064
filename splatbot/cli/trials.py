"""`splatbot trials`."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Annotated, Literal

import tyro

from splatbot.cli.drawing import draw_offscreen
from splatbot.cli.paths import check_output


def trials(
    *,
    scenes: Literal["tabletop", "isolated", "packed", "bin", "shelf"] = "tabletop",
    trials: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    full: bool = False,
    stacks: Annotated[tuple[str, ...], tyro.conf.arg(metavar="NAME ...")] = ("gaussians",),
    first: Annotated[int, tyro.conf.arg(metavar="SEED")] = 0,
    jobs: int = 1,
    frames: int = 32,
    width: int = 320,
    moved: float = 0.0,
    videos: bool = False,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    quiet: bool = False,
) -> int:
    """Pick in seeded scenes in the twin, end to end, and report the success rate and the failures.

    The arm's wrist camera scans each scene with noise and holes in its depth. The frames are mapped, and a click
    selects an object. A stack plans grasp and path with only that map. The pick runs in the twin of the scene. It runs
    again in a twin ("reality") with other friction, masses, gains, delays and contact settings, and every effect. It
    succeeds if the hand lifts the object by 15 cm and still holds it after shaking. All stacks get the same frames at
    the same poses.

    Isolated scenes have one object. Tabletop scenes have cups, tools and clutter, and a moving object in every fifth.
    Packed scenes have standing objects with small gaps, bin scenes a pile, and shelf scenes objects below a board.

    In packed, bin and shelf scenes any object may be picked, the one with the best grasp. Exact masks mark the objects
    in every fourth frame. Some objects are black or of glass; both lack depth.

    Stacks: gaussians (the map), gaussians_look (with a look from the wrist), mesh (fused depth, marching cubes,
    python-fcl), cloud (points, an octree, python-fcl).

    Writes a line of trials.jsonl for each stack in each scene. A second run continues an interrupted one. Writes
    trials.json with the table and the physics that it holds for.

    Examples:
        splatbot trials --jobs 2
        splatbot trials --scenes bin --trials 100 --jobs 2 --videos --out runs/bin
        splatbot trials --moved 0.02 --stacks gaussians gaussians_look --out runs/moved
        splatbot trials --full --stacks gaussians mesh cloud --jobs 2 --out runs/trials

    Args:
        scenes: kind of scenes, as above.
        trials: number of scenes; by default 50, or 27 with isolated objects.
        full: run 250 scenes.
        stacks: stacks to compare: gaussians, gaussians_look, mesh, cloud.
        first: seed of the first scene.
        jobs: number of processes.
        frames: frames of each scan.
        width: width of its images [px].
        moved: distance by which the target is pushed aside after the scan, as by a person [m].
        videos: write a video of each pick that failed in reality.
        out: folder to write to; by default runs/trials.
        quiet: print only errors.
    """
    check_output(out)
    if videos:
        draw_offscreen()

    import json

    from splatbot.atomic import atomic_write
    from splatbot.cli.progress import shares
    from splatbot.sim.trials.run import TrialsPlan, run_trials
    from splatbot.sim.trials.scenes import make_trial
    from splatbot.sim.trials.table import physics, summaries

    count = trials if trials is not None else 250 if full else 27 if scenes == "isolated" else 50
    plan = TrialsPlan(scenes, count, stacks, first, jobs, frames, width, videos, moved)
    folder = out if out is not None else Path("runs") / "trials"
    with shares(quiet) as tell:
        rows, interrupted = run_trials(plan, folder, on_progress=tell)
    found = summaries(rows)
    values = {
        "scenes": scenes,
        "moved_m": moved,
        "interrupted": interrupted,
        "physics": physics(make_trial(first, scenes)),
        "stacks": found,
    }
    with atomic_write(folder / "trials.json") as handle:
        handle.write((json.dumps(values, indent=1, allow_nan=False) + "\n").encode())
    if not quiet:
        _print(values, folder)
    return 130 if interrupted else 0


def _print(values: Mapping[str, object], folder: Path) -> None:
    from typing import Any, cast

    from rich.table import Table

    from splatbot.cli.tables import print_columns
    from splatbot.sim.trials.table import HEAD, table_rows

    table = Table(*HEAD, title=f"picks, {values['scenes']}")
    for row in table_rows(cast(list[dict[str, Any]], values["stacks"])):
        table.add_row(*row)
    print_columns(table)
    for name, value in cast(dict[str, Any], values["physics"]).items():
        print(f"{name}: {value}")
    print(f"written to {folder}")

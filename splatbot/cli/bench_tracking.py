"""`splatbot bench tracking`."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

if TYPE_CHECKING:
    from splatbot.bench.results import Results


def bench_tracking(
    logs: Annotated[tuple[str, ...], tyro.conf.Positional, tyro.conf.arg(metavar="LOG ...")] = (),
    /,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    json: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    csv: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    budgets: Annotated[tuple[float, ...], tyro.conf.arg(metavar="MS ...")] = (30.0, 100.0, 300.0, 1000.0),
    no_peers: bool = False,
    max_frames: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    stress: bool = False,
    config: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    camera: Annotated[str | None, tyro.conf.arg(metavar="PRESET|FILE")] = None,
) -> int:
    """Measure tracking: error against milliseconds, beside other trackers.

    Each log is tracked with each time budget, and by other trackers in the same process: OpenCV's and Open3D's RGB-D
    odometry, small_gicp, and ORB with PnP against keyframes. Errors are ATE (RMSE over all tracked frames, aligned by a
    rigid motion) and RPE; milliseconds are those until the pose is known, without decoding and without mapping.
    NEES / 6 is 1 where poses err as much as they say they may (error of the reference included).

    --stress runs hard synthetic logs with exact truth: flat walls, a corridor, pure rotation, jumps, depth holes, black
    frames, exposure, a hand. Each frame is within a bound or reported degraded or lost, and the map stays true.

    Examples:
        splatbot bench tracking recordings/desk
        splatbot bench tracking recordings/desk recordings/shelf --no-peers
        splatbot bench tracking --stress
        splatbot bench tracking "synthetic:room?trajectory=loop&frames=90" --budgets 30 100 --json figures.json

    Args:
        logs: recordings with a reference trajectory, as for splatbot map; of one name they are numbered as given.
        out: folder for tracking.json, tracking.csv and the plot; by default runs/bench-tracking.
        json: another place for the JSON file.
        csv: another place for the CSV file.
        budgets: time budgets per frame [ms].
        no_peers: leave the other trackers out.
        max_frames: read only the first N frames of each log.
        stress: run the hard synthetic logs; LOG and --budgets are not needed.
        config: YAML file with what all runs share.
        camera: intrinsics instead of the logs' own: tum_fr1, tum_fr2, tum_fr3 or an intrinsics.json.
    """
    from splatbot.errors import InputError

    if not logs and not stress:
        raise InputError("is missing.", field="LOG", hint="name recordings: splatbot bench tracking LOG ...")
    if max_frames is not None and max_frames < 3:
        raise InputError(f"is {max_frames}.", field="--max-frames", hint="give at least 3")
    if not budgets or min(budgets) <= 0:
        raise InputError(f"is {budgets}.", field="--budgets", hint="give milliseconds, as in 30 100")

    from splatbot.bench.tracking import TrackingPlan, run_tracking
    from splatbot.cli.bench_tables import say_progress
    from splatbot.config import load_config
    from splatbot.logs import open_log

    folder = out if out is not None else Path("runs") / "bench-tracking"
    plan = TrackingPlan(
        budgets=budgets,
        peers=not no_peers,
        max_frames=max_frames,
        config=load_config(config),
        stress=stress,
        say=say_progress,
    )
    results = run_tracking([open_log(log, camera=camera) for log in logs], plan, folder)
    if json is not None:
        results.write_json(json)
    if csv is not None:
        results.write_csv(csv)
    _print(results, folder)
    return 0


def _print(results: Results, folder: Path) -> None:
    from splatbot.bench.stress import AFTER, DEGRADED, RECOVERY, SILENT, STRESS, VIEWS, WORST
    from splatbot.bench.stress import LOST as STRESS_LOST
    from splatbot.bench.tracking import ATE, FRAME_MS, LOST, NEES, PERCENTILES, RESIDENT, RPE, RPE_ROT, TRACKED
    from splatbot.cli.bench_tables import figure_table, tell_machine, wide_console

    console = wide_console()
    tell_machine(console, results.machine)
    metrics = (ATE, RPE, RPE_ROT, NEES, TRACKED, LOST, *(f"p{p}" for p in PERCENTILES), FRAME_MS, RESIDENT)
    hard = results.select(STRESS)
    if not hard or len(results.rows) > len(hard):
        console.print(figure_table("Tracking", [row for row in results.rows if row not in hard], metrics))
    if hard:
        columns = ("bound", SILENT, WORST, DEGRADED, STRESS_LOST, RECOVERY, AFTER, VIEWS)
        console.print(figure_table("Hard logs", hard, columns))
    console.print(f"written to {folder}")

"""`splatbot merge`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from splatbot.cli.messages import print_message
from splatbot.cli.paths import check_output, check_state
from splatbot.results.merge_output import check_merge, draft_of, restore_run

if TYPE_CHECKING:
    from splatbot.mapping.alignment import MapAlignment
    from splatbot.mapping.joining import JoinedModel
    from splatbot.run.merging import MergedRun


def merge(
    a: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="A")],
    b: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="B")],
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="DIR")],
    overwrite: bool = False,
    no_report: bool = False,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
    quiet: bool = False,
) -> int:
    """Merge run A and a later run B of the same place into one run, in the world of A.

    Several keyframes of B must agree on the pose of B in A; otherwise nothing is written. Surface of both is fused. A
    loses the surface that the depth of B sees through, and B adds the surface that A lacks. DIR is a run folder like
    any other; its log plays both recordings (recordings.yaml). merge.json has the figures of the merge. DIR is not
    touched before the merged run is whole. Ctrl-C during the refinement saves the run up to there, but does not replace
    another run.

    Examples:
        splatbot merge runs/monday runs/tuesday --out runs/both
        splatbot merge runs/both runs/wednesday --out runs/all --no-report

    Args:
        a: a folder that `splatbot map` wrote, with its saved state.
        b: the later one.
        out: folder to write.
        overwrite: replace the run that --out holds, once the merged one is whole. Other files, as scene.yaml, stay.
        no_report: write no audit, report.html and map.html, which take seconds.
        as_json: print merge.json.
        quiet: no progress and no summary.
    """
    check_runs(a, b)
    restore_run(out)
    check_merge(a, b, out, overwrite=overwrite)
    check_output(out, folder=True)
    check_output(draft_of(out), folder=True)

    from splatbot.cli.map_page import page_of_map
    from splatbot.cli.progress import progress_display, shares
    from splatbot.run.merging import align_runs, merge_runs

    with shares(quiet) as on_share:
        pair = align_runs(a, b, lambda share: on_share("locating B in A", share))
    with progress_display(quiet=quiet) as on_progress:
        found = merge_runs(
            pair,
            out=out,
            on_progress=on_progress,
            map_page=page_of_map,
            report=not no_report,
            overwrite=overwrite,
        )
    if not found.saved:
        print_message("warning", f"the merge ended early, and {out} keeps its earlier run.")
    elif as_json:
        print(json.dumps(found.summary(), indent=2, allow_nan=False))
    elif not quiet:
        _print(out, found)
    return found.run.exit_code


def check_runs(a: Path, b: Path) -> None:
    """Check that both paths are folders of runs with a saved state.

    Raises:
        FormatError: one is no run, or has no saved state.
    """
    check_state(a, "A")
    check_state(b, "B")


def pose_rows(alignment: MapAlignment) -> list[tuple[str, str]]:
    """Return the pose of B in A as names and values."""
    from splatbot.geometry import rotation_to_quat
    from splatbot.results.units import degrees, metres

    moved, turned = alignment.sigmas
    return [
        ("translation of B [m]", " ".join(f"{x:z.4f}" for x in alignment.T_a_b[:3, 3])),
        ("quaternion of B (wxyz)", " ".join(f"{x:z.5f}" for x in rotation_to_quat(alignment.T_a_b[:3, :3]))),
        ("standard deviation", f"{metres(moved)}, {degrees(turned)}"),
        ("keyframes of B", f"{len(alignment.located)} agree, {alignment.found} found, {alignment.tried} searched"),
    ]


def _refined(joined: JoinedModel, refined: int) -> str:
    """Return the number of Gaussians after the refinement as the sum of those that remain, join and appear."""
    more = refined - joined.kept - joined.added
    by_refinement = f"{more:,} more" if more >= 0 else f"{-more:,} fewer"
    return f"{refined:,}: {joined.kept:,} kept, {joined.added:,} added, {by_refinement} by the refinement"


def _print(out: Path, found: MergedRun) -> None:
    from splatbot.cli.tables import print_table
    from splatbot.results.units import count, metres

    joined, metrics = found.joined, found.run.metrics
    rows = [
        *pose_rows(found.alignment),
        ("overlap", f"{joined.overlap:.0%} of the Gaussians of B lie on the surface of A"),
        ("Gaussians of A", f"{count(joined.kept)} kept, {count(joined.removed)} removed"),
        ("Gaussians of B", f"{count(joined.added)} added, {count(joined.covered)} on the surface of A"),
        ("Gaussians, refined", _refined(joined, metrics["gaussians"])),
        ("ATE RMSE", metres(metrics["ate_rmse_m"])),
        *([("time offset of B", f"{found.time_offset:.3f} s")] if found.time_offset else []),
    ]
    print_table(rows, title=f"merged into {out}")

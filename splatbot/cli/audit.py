"""`splatbot audit`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from splatbot.cli.paths import check_camera, check_run
from splatbot.layouts import log_kind

if TYPE_CHECKING:
    from splatbot.results.audit import RunAudit


def audit(
    run: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN")],
    /,
    log: Annotated[str | None, tyro.conf.arg(metavar="LOG")] = None,
    camera: Annotated[str | None, tyro.conf.arg(metavar="PRESET|FILE")] = None,
    n_sigma: float = 2.0,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
) -> int:
    """Check the map of a run against the depth that its frames measured.

    A surface point counts if two other frames measured it too and hardly any frame saw through it. It is missed if it
    is more than 1 cm from the collision field. A free point counts if three frames saw through it; it must not collide.
    Writes audit.json and audit.png into the run folder. At most 40 frames with 5,000 points each are used.

    Examples:
        splatbot audit runs/latest
        splatbot audit runs/desk --log /mnt/recordings/desk --json

    Args:
        run: a folder that `splatbot map` wrote.
        log: where the recording is now, if it was moved.
        camera: intrinsics instead of those that the run used.
        n_sigma: surface of a Gaussian, in standard deviations.
        as_json: print JSON instead of tables.
    """
    check_run(run)
    if log is not None:
        log_kind(log)
    check_camera(camera)

    from splatbot.atomic import atomic_write
    from splatbot.cli.progress import steps
    from splatbot.report.audit import audit_png
    from splatbot.results.audit import audit_run
    from splatbot.results.folder import RunFolder
    from splatbot.robots.in_view import reopen_log

    folder = RunFolder(run)
    with steps() as tell:
        tell("comparing the map with measured depth")
        found = audit_run(folder, reopen_log(folder, uri=log, camera=camera), n_sigma=n_sigma)
        summary = found.summary()
        folder.save_audit(summary)
        tell("drawing audit.png")
        with atomic_write(run / "audit.png") as file:
            file.write(audit_png(found))
    if as_json:
        print(json.dumps(summary, indent=2, allow_nan=False))
    else:
        _print(run, found, summary)
    return 0


def _print(run: Path, found: RunAudit, summary: dict[str, Any]) -> None:
    from splatbot.cli.tables import print_table
    from splatbot.report.audit import distance_rows, hole_rows, object_rows, verdict_rows

    print_table(verdict_rows(summary), title=str(run))
    for title, rows in (
        ("by distance from the camera: points, missed, error of 99.9 %", distance_rows(summary)),
        ("by object (numbers of splatbot objects): points, missed, largest error", object_rows(summary)),
        ("largest holes: length x width, depth, centre [m]", hole_rows(summary)),
    ):
        if rows:
            print_table([(name, "  ".join(cells)) for name, *cells in rows], title=title)
    print(f"  written to {run / 'audit.json'} and audit.png (frame {found.index})")

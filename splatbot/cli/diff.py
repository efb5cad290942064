"""`splatbot diff`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from splatbot.cli.merge import check_runs, pose_rows
from splatbot.cli.paths import check_output
from splatbot.errors import InputError

if TYPE_CHECKING:
    from splatbot.run.comparing import RunComparison


def diff(
    a: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="A")],
    b: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="B")],
    /,
    *,
    aligned: bool = False,
    as_json: Annotated[bool, tyro.conf.arg(name="json")] = False,
    out: Annotated[Path | None, tyro.conf.arg(metavar="PNG")] = None,
    quiet: bool = False,
) -> int:
    """List the objects that appeared, moved or were removed between run A and a later run B of the same place.

    B is located in A by its keyframes. An object is removed if A measured it and B saw through it, and appeared if B
    measured it and A saw through it. Space that one of them did not see is no change. Writes a picture of both maps.

    Examples:
        splatbot diff runs/monday runs/tuesday
        splatbot diff runs/monday runs/tuesday --json --out changes.png
        splatbot diff runs/desk runs/desk_again --aligned

    Args:
        a: a folder that `splatbot map` wrote, with its saved state.
        b: the later one.
        aligned: both have the same world, so B is not located in A.
        as_json: print JSON, in which each length names its unit.
        out: the picture; by default diff.png in the folder of B.
        quiet: no progress.
    """
    check_runs(a, b)
    picture = out if out is not None else b / "diff.png"
    if picture.suffix.lower() != ".png":
        raise InputError("is no PNG picture.", file=picture, field="--out", hint="end its name in .png")
    check_output(picture, folder=False)

    from splatbot.atomic import atomic_write
    from splatbot.cli.progress import shares
    from splatbot.gaussians import GaussianModel
    from splatbot.layouts import map_file
    from splatbot.report.changes_view import changes_png
    from splatbot.run.comparing import compare_runs

    before, after = (GaussianModel.load(map_file(run)) for run in (a, b))
    with shares(quiet) as on_share:
        found = compare_runs(a, b, aligned=aligned, on_share=on_share)
    with atomic_write(picture) as handle:
        handle.write(changes_png(before, after, found.T_a_b, found.objects, found.views))
    if as_json:
        print(json.dumps({**found.summary(), "picture": str(picture)}, indent=2, allow_nan=False))
        return 0
    _print(found)
    print(f"picture: {picture}")
    return 0


def _print(found: RunComparison) -> None:
    from rich.table import Table

    from splatbot.cli.tables import print_columns, print_table, print_text

    if found.alignment is not None:
        print_table(pose_rows(found.alignment), title="B in A")
    if not found.objects:
        print_text("no object differs where both runs measured depth")
        return
    table = Table("object", "change", "centre in A, m", "size, mm", title="changes", title_justify="left")
    for number, change in enumerate(found.objects, 1):
        at = " ".join(f"{x:z.2f}" for x in change.center)
        if change.previous is not None:
            at = " ".join(f"{x:z.2f}" for x in change.previous.center) + f" → {at}"
        size = " x ".join(f"{1e3 * x:.0f}" for x in change.size)
        table.add_row(str(number), change.kind, at, size)
    print_columns(table)

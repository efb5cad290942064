"""`splatbot compact`."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NamedTuple

import tyro

from splatbot.cli.paths import check_new, check_output
from splatbot.errors import InputError
from splatbot.formats import find_format
from splatbot.layouts import map_file

if TYPE_CHECKING:
    from splatbot.gaussians import GaussianModel
    from splatbot.optimize.compact import FieldChange
    from splatbot.training.map_views import MapViews

_SHARES = (1.0, 0.75, 0.5, 0.35, 0.25, 0.1)  # of a sweep
_MOST_VIEWS = 100  # that give the importance
_MOST_SCORED = 20
_VIRTUAL_VIEWS = 48
_CERTIFIED = ("ply", "sbz")  # formats that keep each ellipsoid, or enclose it


def compact(
    map: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="RUN|TRAINING|MAP")],
    /,
    *,
    out: Annotated[Path | None, tyro.conf.arg(metavar="FILE")] = None,
    keep: Annotated[float | None, tyro.conf.arg(metavar="SHARE")] = None,
    max_gaussians: Annotated[int | None, tyro.conf.arg(metavar="N")] = None,
    sh_degree: Annotated[int | None, tyro.conf.arg(metavar="D")] = None,
    cameras: Annotated[Path | None, tyro.conf.arg(metavar="RUN|TRAINING")] = None,
    log: Annotated[str | None, tyro.conf.arg(metavar="LOG")] = None,
    sweep: bool = False,
    overwrite: bool = False,
) -> int:
    """Write a map of fewer Gaussians: groups of similar neighbours become one Gaussian each.

    The importance of a Gaussian is its blend weight, summed over the views of the recording. Groups are split where
    images show detail, until the number is reached. Nothing is trained.

    No surface vanishes for an arm. Each Gaussian of the result encloses its group at 2 and more standard deviations, so
    a body that hits the map hits the result. The price is free space: the summary has the loss of clearance. The
    promise holds for .ply and .sbz; other formats round ellipsoids.

    A map file without a recording next to it is weighed by 48 virtual views from outside. For rooms, name the run with
    --cameras.

    Examples:
        splatbot compact runs/desk --sweep
        splatbot compact runs/desk --keep 0.5 --out desk-half.ply
        splatbot compact runs/garden-trained --max-gaussians 50000 --sh-degree 1 --out garden.spz
        splatbot compact scene.ply --cameras runs/room --keep 0.3 --out small.sbz

    Args:
        map: the folder of a run or a training, or a map file.
        out: file to write, as its suffix says (see `splatbot convert`).
        keep: share of the Gaussians that the result has, above 0 and at most 1.
        max_gaussians: largest number of Gaussians of the result.
        sh_degree: highest degree of spherical harmonics to keep; by default all.
        cameras: the run or training whose views give the importance; by default the one of MAP.
        log: where the recording of the run is now, if it was moved.
        sweep: print quality, size and clearance for shares of 1 to 0.1; write nothing.
        overwrite: replace the file that --out names.
    """
    file = map_file(map)
    _check(file, out, keep, max_gaussians, sh_degree, sweep=sweep)
    if out is not None:
        check_new(out, overwrite=overwrite)

    from splatbot.cli.map_views import recorded_views
    from splatbot.cli.progress import shares
    from splatbot.cli.tables import print_text
    from splatbot.formats import load_gaussians

    model = load_gaussians(file)
    recorded = recorded_views(cameras or map, log)
    if recorded is None and cameras is not None:
        hint = "give a folder that `splatbot map` or `splatbot train` wrote"
        raise InputError("is no run and no training.", file=cameras, field="--cameras", hint=hint)
    print_text(f"importance from {_source(recorded)}")
    counts = _counts(len(model), keep, max_gaussians, sweep=sweep)
    results: list[_Result] = []
    with shares(quiet=False) as on_share:
        on_share("rendering views", 0.0)
        weights = _weights(model, recorded)
        for done, count in enumerate(counts, 1):
            on_share(f"{count:,} Gaussians", done / (len(counts) + 1))
            results.append(_result(model, weights, count, sh_degree, recorded))
    _print(model, results, recorded)
    if out is not None:
        _save(results[0].model, out)
    return 0


class _Result(NamedTuple):
    model: GaussianModel
    scores: dict[str, Any]  # of held-out views
    change: FieldChange


def _check(
    file: Path, out: Path | None, keep: float | None, count: int | None, sh_degree: int | None, *, sweep: bool
) -> None:
    """Refuse options that do not fit together.

    Raises:
        InputError: an option is out of range, is missing, or excludes another one.
    """
    if sweep:
        for name, value in (("--out", out), ("--keep", keep), ("--max-gaussians", count)):
            if value is not None:
                raise InputError("excludes --sweep.", field=name, hint="leave one of them out")
    elif out is None:
        raise InputError("is missing.", field="--out", hint="name a file to write, or give --sweep")
    elif (keep is None) == (count is None):
        raise InputError("is needed once.", field="--keep, --max-gaussians", hint="give one of them")
    if keep is not None and not 0.0 < keep <= 1.0:
        raise InputError(f"is {keep:g}.", field="--keep", hint="give a share above 0 and at most 1, as 0.5")
    if count is not None and count < 1:
        raise InputError(f"is {count}.", field="--max-gaussians", hint="give 1 or more")
    if sh_degree is not None and not 0 <= sh_degree <= 4:
        raise InputError(f"is {sh_degree}.", field="--sh-degree", hint="give 0 to 4")
    if out is not None:
        check_output(out, folder=find_format(out).suffix == "_sog")
        if out.resolve() in (file.resolve(), file.resolve().parent):
            raise InputError("is the input.", file=out, field="--out", hint="name another file")


def _counts(total: int, keep: float | None, count: int | None, *, sweep: bool) -> list[int]:
    if count is not None:
        return [count]
    shares = _SHARES if sweep or keep is None else (keep,)
    return [max(1, round(share * total)) for share in shares]


def _source(recorded: MapViews | None) -> str:
    if recorded is None:
        return f"{_VIRTUAL_VIEWS} virtual views from outside of the map"
    return f"{min(len(recorded.mapped), _MOST_VIEWS)} of {len(recorded.mapped)} views of {recorded.recording}"


def _weights(model: GaussianModel, recorded: MapViews | None) -> Any:
    from splatbot.optimize.importance import blended_weights
    from splatbot.spacing import evenly_spaced
    from splatbot.training.map_views import around

    if recorded is None:
        return blended_weights(model, around(model, _VIRTUAL_VIEWS))
    views = evenly_spaced(recorded.mapped, _MOST_VIEWS)
    return blended_weights(model, ((view.camera, view.T_world_camera) for view in views))


def _result(
    model: GaussianModel, weights: Any, count: int, sh_degree: int | None, recorded: MapViews | None
) -> _Result:
    from splatbot.optimize.compact import compact as compacted
    from splatbot.optimize.compact import field_change

    kept = compacted(model, weights, count)
    if sh_degree is not None:
        kept = replace(kept, sh=kept.sh[:, : (sh_degree + 1) ** 2].contiguous())
    scores = recorded.score(kept, _MOST_SCORED) if recorded is not None else {}
    return _Result(kept, scores, field_change(model, kept))


def _save(model: GaussianModel, out: Path) -> None:
    from splatbot.cli.tables import print_text
    from splatbot.formats.ply import save_ply
    from splatbot.results.units import megabytes

    target = find_format(out)
    if target.module == "ply":
        save_ply(model, out, bookkeeping=True)  # unobserved Gaussians must stay marked for collision checks
    else:
        target.save(model, out)
    size = sum(file.stat().st_size for file in out.iterdir()) if out.is_dir() else out.stat().st_size
    print(f"{out}: {megabytes(size)}")
    if target.module not in _CERTIFIED:
        print_text(f"note: {target.name} rounds ellipsoids; use .ply or .sbz for collision checks")


def _print(model: GaussianModel, results: list[_Result], recorded: MapViews | None) -> None:
    from rich.table import Table

    from splatbot.cli.tables import print_columns, print_text
    from splatbot.results.units import count, decibels, megabytes, metres, number, percent

    names = (
        "Gaussians",
        "share",
        "in memory",
        "PSNR",
        "SSIM",
        "hit, but free now",
        "free, but hit now",
        "clearance lost",
    )
    table = Table(*names)
    for kept, scores, change in results:
        table.add_row(
            count(len(kept)),
            f"{100 * len(kept) / len(model):.3g} %",  # one of many Gaussians is not 0 %
            megabytes(kept.nbytes),
            decibels(scores.get("psnr_db")),
            number(scores.get("ssim"), 3),
            f"{change.missed} of {change.hit:,}",
            percent(change.blocked / max(change.free, 1)),
            metres(change.closer_m),
        )
    print_columns(table)
    held_out = 0 if recorded is None else min(len(recorded.held_out), _MOST_SCORED)
    scored = f"PSNR and SSIM are means of {held_out} held-out views. " if held_out else "No held-out view is known. "
    print_text(f"{scored}The last three columns compare 100,000 random spheres within some cm of surfaces, at 2 sigma.")

"""`splatbot compare`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import tyro

from splatbot.cli.paths import check_output
from splatbot.errors import InputError, SplatbotError
from splatbot.layouts import map_file

if TYPE_CHECKING:
    from splatbot.gaussians import GaussianModel
    from splatbot.report.compare import PageMap
    from splatbot.training.comparison import ComparedView
    from splatbot.training.map_views import MapViews

_MOST_VIEWS = 40  # of a page, about 1 MB each


def compare(
    a: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="A")],
    b: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="B")],
    /,
    *,
    out: Annotated[Path, tyro.conf.arg(metavar="FILE")] = Path("compare.html"),
    views: Annotated[int, tyro.conf.arg(metavar="N")] = 6,
    log: Annotated[str | None, tyro.conf.arg(metavar="LOG")] = None,
) -> int:
    """Compare two maps as one HTML page: sliders between their images and depths, differences, and scores.

    A and B are runs, trainings, or map files of any format. The views are those of A's recording, else of B's, and the
    held-out ones if there are some. Without a recording, virtual views around A are compared. The maps must be in
    one frame; the page has a banner if their images do not overlap or their depths disagree.

    Two runs of one recording estimate their own poses. Against the recorded images, each is rendered from its own. The
    figures go to the terminal and to a JSON file next to the page.

    Examples:
        splatbot compare runs/desk desk-half.ply
        splatbot compare runs/garden-trained garden.spz --views 12 --out garden.html
        splatbot compare scene.ply scene.sog

    Args:
        a: first map.
        b: second map.
        out: page to write.
        views: number of views, 1 to 40.
        log: where the recording of the run is now, if it was moved.
    """
    files = map_file(a), map_file(b)
    if not 1 <= views <= _MOST_VIEWS:
        raise InputError(f"is {views}.", field="--views", hint=f"give 1 to {_MOST_VIEWS}")
    if out.suffix.lower() not in (".html", ".htm"):
        raise InputError("is no HTML page.", file=out, field="--out", hint="end its name in .html")
    check_output(out, folder=False)

    from splatbot.atomic import replace_files, write_text
    from splatbot.formats import load_gaussians
    from splatbot.report.compare import compare_html, to_json
    from splatbot.results.metrics import without_nan
    from splatbot.training.comparison import doubts, summary

    models = [load_gaussians(file) for file in files]
    for file, model in zip(files, models, strict=True):
        if not len(model):
            raise InputError("is empty.", file=file, field="map", hint="give a map that has Gaussians")
    compared, notes = _compared(models[0], models[1], a, b, views, log)
    means = summary(compared)
    notes += doubts(means)
    pages = [_page_map(path, file, model) for path, file, model in zip((a, b), files, models, strict=True)]
    figures = without_nan(to_json(pages[0], pages[1], compared, means, notes))
    writers = {
        out.name: write_text(compare_html(pages[0], pages[1], compared, means, notes)),
        out.with_suffix(".json").name: write_text(json.dumps(figures, indent=2, allow_nan=False) + "\n"),
    }
    replace_files(out.parent, writers)
    _print(pages[0], pages[1], means, notes)
    print(f"{out} ({len(compared)} views), {out.with_suffix('.json').name}")
    return 0


def _compared(
    model_a: GaussianModel, model_b: GaussianModel, a: Path, b: Path, count: int, log: str | None
) -> tuple[list[ComparedView], list[str]]:
    """Return the compared views, and notes on recordings that cannot be read."""
    from splatbot.cli.map_views import recorded_views
    from splatbot.training.comparison import compare_around, compare_recorded

    notes: list[str] = []
    found: list[MapViews | None] = []
    for path in (a, b):
        try:
            found.append(recorded_views(path, log))
        except SplatbotError as error:
            notes.append(f"The recording of {path} cannot be read: {error}")
            found.append(None)
    of_a, of_b = found
    if of_a is not None:
        own = of_b if of_b is not None and of_b.recording == of_a.recording else None
        return list(compare_recorded(model_a, model_b, of_a, own, count)), notes
    if of_b is not None:
        return list(compare_recorded(model_a, model_b, of_b, None, count)), notes
    return list(compare_around(model_a, model_b, count)), notes


def _page_map(path: Path, file: Path, model: GaussianModel) -> PageMap:
    from splatbot.report.compare import PageMap

    folder = file.parent if file.name == "meta.json" else file
    size = sum(part.stat().st_size for part in folder.iterdir()) if folder.is_dir() else file.stat().st_size
    return PageMap(str(path), len(model), model.sh_degree, size)


def _print(a: PageMap, b: PageMap, means: dict[str, float | None], notes: list[str]) -> None:
    from rich.table import Table

    from splatbot.cli.tables import print_columns, print_table, print_text
    from splatbot.report.compare import comparison_rows
    from splatbot.results.units import decibels, number, percent

    table = Table("", "A", "B")
    for row in comparison_rows(a, b, means):
        table.add_row(*row)
    print_columns(table)
    difference = means["depth_difference"]
    print_table(
        [
            ("PSNR of B against A", decibels(means["psnr_db"])),
            ("SSIM of B against A", number(means["ssim"], 3)),
            ("pixels that both cover", percent(means["overlap"])),
            ("median difference of depth", "-" if difference is None else f"{100 * difference:.2f} %"),
        ]
    )
    for text in notes:
        print_text(f"note: {text}")

"""Quality of held-out views over the seconds of training, a panel per knob."""

from __future__ import annotations

from pathlib import Path

from splatbot.bench.plots import Panel, PlotCurve, Point, save_plot
from splatbot.bench.results import Results


def plot_training(results: Results, out: Path) -> None:
    """Write ``training.png``, ``.svg``: PSNR against seconds, the default setting in each panel."""
    courses = {case: [Point(*pair) for pair in course] for case, course in results.curves.items()}
    if not courses.get("(default)"):  # of a benchmark that was interrupted
        return
    *before, end = courses.pop("(default)")
    default = PlotCurve("default setting", [*before, Point(end.x, end.y, default=True)])
    knobs = dict.fromkeys(case.split()[0] for case in courses) or {"": None}
    panels = [
        Panel(
            knob,
            "time of training [s]",
            "PSNR of held-out views [dB]",
            [default, *(PlotCurve(case, course) for case, course in courses.items() if case.split()[0] == knob)],
        )
        for knob in knobs
    ]
    save_plot(panels, out, "training")

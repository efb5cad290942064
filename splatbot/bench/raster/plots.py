"""Curves of the benchmark: error against milliseconds, and growth."""

from __future__ import annotations

from pathlib import Path

from splatbot.bench.plots import Panel, PlotCurve, Point, save_plot
from splatbot.bench.raster.sweeps import GROWTH, SWEEP
from splatbot.bench.results import Results

_KNOBS = ("radius_clip", "percent_of_gaussians", "sh_degree", "unscented_transform")
_DEFAULT = " (default)"


def plot_sweeps(results: Results, out: Path) -> None:
    """Write ``raster-sweeps.png``, ``.svg``: largest error over time, a panel per knob, the default marked."""
    panels = [
        Panel(knob, "forward [ms]", "largest error of a colour", [PlotCurve("splatbot", points)], "linear", "log")
        for knob in _KNOBS
        if (points := _points(results, knob))
    ]
    save_plot(panels, out, "raster-sweeps")


def plot_growth(results: Results, out: Path) -> None:
    """Write ``raster-growth.png`` and ``.svg``: time against Gaussians and against pixels, with a line of slope one."""
    panels = []
    for kind in ("gaussians", "pixels"):
        rows = results.select(f"{GROWTH} {kind}: ")
        curves = []
        for metric in ("forward+backward", "stages over Gaussians", "stages over pixels"):
            points = [Point(int(r.case.rpartition(" ")[2]), r.value) for r in rows if r.metric == metric and r.value]
            curves.append(PlotCurve(metric, points))
        if not curves[0].points:  # of a benchmark that was interrupted
            continue
        first, last = curves[0].points[0], curves[0].points[-1]
        slope = last.y / last.x
        curves.append(PlotCurve("linear", [Point(first.x, slope * first.x), Point(last.x, last.y)], "reference"))
        panels.append(Panel(f"Growth with {kind}", kind, "time [ms]", curves, "log", "log"))
    save_plot(panels, out, "raster-growth")


def _points(results: Results, knob: str) -> list[Point]:
    """Return time [ms] and error of the settings that ran."""
    rows = results.select(f"{SWEEP} {knob} on ")
    points = []
    for case in dict.fromkeys(row.case for row in rows):
        figures = {row.metric: row.value for row in rows if row.case == case}
        ms, error = figures.get("forward"), figures.get("largest error")
        if ms is not None and error is not None:
            label = case.rpartition(": ")[2]
            points.append(Point(ms, error, label.removesuffix(_DEFAULT), label.endswith(_DEFAULT)))
    return points

"""Curves of the benchmark: error against milliseconds, and growth."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.figure import Figure

from splatbot.bench.raster.sweeps import GROWTH, SWEEP
from splatbot.bench.results import Results

_KNOBS = ("radius_clip", "percent_of_gaussians", "sh_degree", "unscented_transform")


def plot_sweeps(results: Results, out: Path) -> None:
    """Write ``raster-sweeps.png``, ``.svg``: largest error over time, a panel per knob, the default marked."""
    panels = [(knob, points) for knob in _KNOBS if (points := _points(results, knob))]
    figure, axes = plt.subplots(1, max(1, len(panels)), figsize=(4.2 * max(1, len(panels)), 3.6), squeeze=False)
    for axis, (knob, points) in zip(axes[0], panels, strict=False):
        axis.plot([ms for ms, _, _, _ in points], [error for _, error, _, _ in points], "o-", color="#2a6f97")
        for ms, error, label, default in points:
            axis.annotate(label, (ms, error), textcoords="offset points", xytext=(5, 5), fontsize=8)
            if default:
                axis.plot([ms], [error], "o", color="#d1495b", markersize=9)
        axis.set(title=knob, xlabel="forward [ms]", ylabel="largest error of a colour", yscale="symlog")
        axis.set_yscale("symlog", linthresh=1e-6)
        axis.grid(alpha=0.3)
    _save(figure, out, "raster-sweeps")


def plot_growth(results: Results, out: Path) -> None:
    """Write ``raster-growth.png`` and ``.svg``: time against Gaussians and against pixels, with a line of slope one."""
    figure, axes = plt.subplots(1, 2, figsize=(9.5, 3.8))
    for axis, kind in zip(axes, ("gaussians", "pixels"), strict=True):
        rows = results.select(f"{GROWTH} {kind}: ")
        for metric, marker in (
            ("forward+backward", "o-"),
            ("stages over Gaussians", "s--"),
            ("stages over pixels", "^--"),
        ):
            curve = [(int(r.case.rpartition(" ")[2]), r.value) for r in rows if r.metric == metric and r.value]
            axis.plot(*zip(*curve, strict=True), marker, label=metric)
            if metric == "forward+backward":
                (x0, _), (x1, y1) = curve[0], curve[-1]
                axis.plot([x0, x1], [y1 * x0 / x1, y1], ":", color="grey", label="linear")
        axis.set(xscale="log", yscale="log", xlabel=kind, ylabel="ms")
        axis.legend(fontsize=8)
        axis.grid(alpha=0.3, which="both")
    _save(figure, out, "raster-growth")


def _points(results: Results, knob: str) -> list[tuple[float, float, str, bool]]:
    """Return (time [ms], error, setting, whether it is the default) of the settings that ran."""
    rows = results.select(f"{SWEEP} {knob} on ")
    points = []
    for case in dict.fromkeys(row.case for row in rows):
        figures = {row.metric: row.value for row in rows if row.case == case}
        ms, error = figures.get("forward"), figures.get("largest error")
        if ms is not None and error is not None:
            label = case.rpartition(": ")[2]
            points.append((ms, error, label.removesuffix(" (default)"), label.endswith("(default)")))
    return points


def _save(figure: Figure, out: Path, name: str) -> None:
    figure.tight_layout()
    for suffix in ("png", "svg"):
        figure.savefig(out / f"{name}.{suffix}", dpi=130)
    plt.close(figure)

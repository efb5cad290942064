"""Error against milliseconds, a panel per log."""

from __future__ import annotations

import math
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt
from matplotlib.ticker import FuncFormatter

from splatbot.bench.results import Results

DEFAULT_SETTINGS = ("default", "100 ms")


def plot_tracking(results: Results, out: Path) -> None:
    """Write ``tracking.png``, ``.svg``: ATE against the median of milliseconds; ours joined, the default marked.

    Stress cases and logs whose runs have no error above 0 have no panel.
    """
    names = dict.fromkeys(row.case.partition(",")[0] for row in results.rows)
    panels = {name: points for name in names if (points := _points(results, name))}
    if not panels:
        return
    figure, axes = plt.subplots(1, len(panels), figsize=(4.6 * len(panels), 3.8), squeeze=False)
    for axis, (log, points) in zip(axes[0], panels.items(), strict=True):
        ours = sorted((ms, error) for peer, _, ms, error in points if peer is None)
        axis.plot([ms for ms, _ in ours], [error for _, error in ours], "o-", color="#2a6f97", label="splatbot")
        for peer, setting, ms, error in points:
            axis.annotate(peer or setting, (ms, error), textcoords="offset points", xytext=(5, 5), fontsize=8)
            if peer is not None:
                axis.plot([ms], [error], "s", color="#8d99ae")
            elif setting in DEFAULT_SETTINGS:
                axis.plot([ms], [error], "o", color="#d1495b", markersize=9)
        axis.set(title=log, xlabel="median per frame [ms]", ylabel="ATE RMSE [mm]", xscale="log", yscale="log")
        axis.grid(alpha=0.3, which="both")
        for side, form in ((axis.xaxis, _spaced), (axis.yaxis, _plain)):
            side.set_major_formatter(FuncFormatter(form))
            side.set_minor_formatter(FuncFormatter(form))
        axis.tick_params(which="both", labelsize=7)
    figure.tight_layout()
    for suffix in ("png", "svg"):
        figure.savefig(out / f"tracking.{suffix}", dpi=130)
    plt.close(figure)


def _plain(value: float, _: int) -> str:
    return f"{value:g}"


def _spaced(value: float, _: int) -> str:
    """Format a number of a logarithmic axis; some of each decade stay empty, because labels would overlap."""
    digit = round(value / 10 ** math.floor(math.log10(value)))
    return f"{value:g}" if digit in (1, 2, 3, 5, 7) else ""


def _points(results: Results, log: str) -> list[tuple[str | None, str, float, float]]:
    """Return (peer, setting, time [ms], error [mm]) of the runs on a log that have both."""
    points = []
    for row in results.rows:
        name, _, setting = row.case.partition(", ")
        if name != log or row.metric != "ATE" or row.value is None or row.value <= 0:
            continue
        ms = results.find(row.case, "p50", row.peer)
        if ms is not None and ms > 0:
            points.append((row.peer, setting, ms, row.value))
    return points

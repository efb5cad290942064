"""The curve of `splatbot bench planning`: cost against time."""

from __future__ import annotations

from pathlib import Path

from splatbot.bench.planning import BUDGET
from splatbot.bench.plots import Panel, PlotCurve, Point, save_plot
from splatbot.bench.results import Results

DEFAULT_MS = 28.0


def plot_cost(results: Results, out: Path) -> None:
    """Write ``planning-cost.png``, ``.svg``: the mean length of paths over the budget, with peers.

    Error bars are one standard deviation between the seeds. The label of a budget has the share of solved problems
    where it is below 100 %.
    """
    curves: dict[str, list[Point]] = {}
    for row in results.select(f"{BUDGET} "):
        if row.metric != "cost, mean" or row.value is None:
            continue
        budget = float(row.case.split()[1])
        low, high = (None, None) if row.spread is None else (row.value - row.spread, row.value + row.spread)
        label = "" if row.peer else f"{budget:g} ms{_solved(results, row.case)}"
        point = Point(budget, row.value, label, row.peer is None and budget == DEFAULT_MS, low, high)
        curves.setdefault(row.peer or "splatbot", []).append(point)
    drawn = [PlotCurve(name, points) for name, points in curves.items()]
    save_plot([Panel("Planning", "time budget [ms]", "path length, mean [rad]", drawn, "log")], out, "planning-cost")


def _solved(results: Results, case: str) -> str:
    """Return the share of solved problems of a case, as in ", 98 % solved"; empty for all."""
    for row in results.select(case):
        if (row.case, row.metric, row.peer) == (case, "solved", None) and row.value is not None:
            share = row.value / float(row.unit.removeprefix("of "))
            return "" if share == 1.0 else f", {100 * share:.3g} % solved"
    return ""

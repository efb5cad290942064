"""Plot of `splatbot bench sizing`: utilisation of each resource over the number of robots."""

from __future__ import annotations

from pathlib import Path

from splatbot.bench.plots import Panel, PlotCurve, Point, save_plot
from splatbot.bench.results import Results


def plot_utilisation(results: Results, out: Path) -> None:
    """Write ``sizing.png`` and ``.svg``: the share of each resource in use on the planned nodes."""
    robots, shares = results.curves["robots"], results.curves["utilisation"]
    curves = [
        PlotCurve(name, [Point(x, 100.0 * share[name]) for x, share in zip(robots, shares, strict=True)], "line")
        for name in shares[0]
    ]
    planned = results.curves["planned"]
    full = [
        Point(min(robots), 100.0),
        Point(planned, 100.0, f"{planned:g} planned", default=True),
        Point(max(robots), 100.0),
    ]
    curves.append(PlotCurve("100 %", full, "reference"))
    save_plot([Panel("Utilisation", "robots (simulated)", "utilisation [%]", curves, "log", "log")], out, "sizing")

"""Curves of `splatbot bench collision`: error against time, and over n_sigma."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from scipy.stats import binomtest

from splatbot.bench.plots import Panel, PlotCurve, Point, save_plot
from splatbot.bench.results import Results

_DEFAULT = " (default)"


def plot_accuracy(results: Results, out: Path) -> None:
    """Write ``collision-accuracy.png``, ``.svg``: missed collisions of edges over time, certified and sampled."""
    cases = list(dict.fromkeys(row.case for row in results.select("sweep edges on ")))
    curves = []
    for name, certified in (("certified, tolerance", True), ("sampled, samples", False)):
        chosen = [case for case in cases if ("certified" in case) is certified]
        times = [results.find(case, "an edge") for case in chosen]
        curves.append(PlotCurve(name, _missed(results, chosen, times)))
    panel = Panel("Collision checks of edges", "time of an edge [µs]", "missed collisions [%]", curves, "log", "log")
    save_plot([panel], out, "collision-accuracy")


def plot_sigma(results: Results, out: Path) -> None:
    """Write ``collision-sigma.png``, ``.svg``: errors over n_sigma, for the number of Gaussians with most values."""
    by_map: dict[str, list[str]] = {}
    for case in dict.fromkeys(row.case for row in results.select("sweep n_sigma on ")):
        by_map.setdefault(case.partition(":")[0], []).append(case)
    if not by_map:
        return
    title, cases = max(by_map.items(), key=lambda item: len(item[1]))
    sigmas = [float(_setting(case)) for case in cases]
    hits = [
        Point(x, y, default=case.endswith(_DEFAULT))
        for case, x in zip(cases, sigmas, strict=True)
        if (y := results.find(case, "false hit")) is not None
    ]
    curves = [PlotCurve("false hit", hits), PlotCurve("false free", _missed(results, cases, sigmas, labelled=False))]
    name = f"Configurations, {title.removeprefix('sweep n_sigma on ')}"
    save_plot([Panel(name, "n_sigma", "wrong answers [%]", curves, "linear", "log")], out, "collision-sigma")


def _missed(
    results: Results, cases: Sequence[str], places: Sequence[float | None], *, labelled: bool = True
) -> list[Point]:
    """Return the shares of missed collisions [%] at places, with 95 % intervals (Wilson 1927)."""
    points = []
    for case, x in zip(cases, places, strict=True):
        found = [row for row in results.select(case) if row.metric == "false free, count" and row.case == case]
        if x is None or not found or found[0].value is None:
            continue
        missed, total = int(found[0].value), int(found[0].unit.removeprefix("of "))
        interval = binomtest(missed, max(total, 1)).proportion_ci(method="wilson")
        bar = (100.0 * max(interval.low, 0.0), 100.0 * interval.high)
        label = _setting(case).removeprefix("certified, ").removesuffix(" samples") if labelled else ""
        points.append(Point(x, 100.0 * missed / max(total, 1), label, case.endswith(_DEFAULT), *bar))
    return points


def _setting(case: str) -> str:
    """Return the setting of a case, as in "sweep n_sigma on 200000 Gaussians: 2 (default)"."""
    return case.rpartition(": ")[2].removesuffix(_DEFAULT)

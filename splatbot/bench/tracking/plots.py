"""Error against milliseconds of each log."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from splatbot.bench.plots import Panel, PlotCurve, Point, save_plot
from splatbot.bench.results import Results
from splatbot.config import Config


def plot_tracking(results: Results, out: Path) -> None:
    """Write ``tracking.png``, ``.svg``: ATE against the median of milliseconds, the default budget marked.

    The logs share a panel; with other trackers, each log has its own. Stress cases, and logs whose runs have no error
    above 0, are left out.
    """
    curves: dict[tuple[str, str], list[Point]] = {}
    for log, name, point in _points(results):
        curves.setdefault((log, name), []).append(point)
    axes = ("time of a frame, median [ms]", "trajectory error, RMSE [mm]")
    if any(row.peer is not None for row in results.rows):
        logs = dict.fromkeys(log for log, _ in curves)
        of_log = {
            log: [PlotCurve(name or "splatbot", p) for (own, name), p in curves.items() if own == log] for log in logs
        }
        panels = [Panel(log, *axes, found, "log", "log") for log, found in of_log.items()]
    else:
        names = [PlotCurve(f"{log} {name}".rstrip(), points) for (log, name), points in curves.items()]
        panels = [Panel("Tracking", *axes, names, "log", "log")]
    save_plot(panels, out, "tracking")


def _points(results: Results) -> Iterator[tuple[str, str, Point]]:
    """Yield (log, peer or change of an ablation, point) of the runs that have a time and an error above 0."""
    default = f"{Config().tracking.budget_ms:g} ms"
    for row in results.rows:
        log, _, setting = row.case.partition(", ")
        ms = results.find(row.case, "p50", row.peer)
        if row.metric != "ATE" or row.value is None or row.value <= 0 or ms is None or ms <= 0:
            continue
        budget, _, change = setting.partition(" ms ")
        yield log, row.peer or change, Point(ms, row.value, "" if change else budget, default=setting == default)

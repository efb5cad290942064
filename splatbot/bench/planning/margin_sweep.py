"""Missed surface, false hits and solved problems over the margin, on the map of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from splatbot.bench.planning_problems import Problem
from splatbot.bench.plots import Panel, PlotCurve, Point, save_plot
from splatbot.bench.results import Results
from splatbot.collision import GaussianCollisionField
from splatbot.collision.audit import SurfaceAudit
from splatbot.planning import GaussianRRTStar
from splatbot.protocols import Array
from splatbot.robots.panda import panda


@dataclass(frozen=True)
class MarginSweepConstants:
    """Constants of the sweep.

    Args:
        margins: [m] margins of the sweep.
        confidences: shares of the confirmed surface whose margin is reported.
    """

    margins: tuple[float, ...] = (0.0, 0.002, 0.004, 0.006, 0.008, 0.012, 0.016, 0.024)
    confidences: tuple[float, ...] = (0.9, 0.99, 0.999, 0.9999)


CONSTANTS = MarginSweepConstants()


def sweep_margins(
    results: Results,
    name: str,
    audit: SurfaceAudit,
    field: GaussianCollisionField,
    T_world_base: Array,
    problems: Sequence[Problem],
    *,
    budget_ms: float,
) -> None:
    """Measure the three shares at each margin, and the margin at each confidence.

    Missed: confirmed surface points that are farther from the field than the margin, so that the margin does not cover
    them. False hits: confirmed free points that are nearer to the field than the margin. Solved: problems whose ends
    are free without a margin.

    Args:
        results: receives the rows.
        name: name of the run.
        audit: confirmed points of the run.
        field: collision field of its map.
        T_world_base: (4, 4) pose of the arm.
        problems: the problems.
        budget_ms: time of a plan [ms].
    """
    for margin in CONSTANTS.margins:
        planner = GaussianRRTStar(field, panda(), T_world_base=T_world_base, margin=margin)
        solved = [bool(planner.plan(p.start, p.goal, budget_ms=budget_ms, seed=k)) for k, p in enumerate(problems)]
        free = audit.space.free
        hits = field.in_collision(np.c_[free, np.full(len(free), margin)]) if len(free) else np.zeros(0, np.bool_)
        row = (
            100.0 * float((audit.distance > margin).mean()) if len(audit.distance) else 0.0,
            100.0 * float(hits.mean()) if len(hits) else 0.0,
            100.0 * float(np.mean(solved)) if solved else 0.0,
        )
        case = f"{name}, margin {1e3 * margin:.0f} mm"
        for metric, value in zip(("missed surface", "false hits", "solved"), row, strict=True):
            results.add(case, metric, value, "%")
    for share in CONSTANTS.confidences:
        results.add(f"{name}, margin at confidence", f"{share:g}", 1e3 * audit.quantile(share), "mm")


def plot_margins(results: Results, out: Path) -> None:
    """Write ``planning-margins-NAME.png``, ``.svg`` of each run: the three shares over the margin, and confidences."""
    runs = dict.fromkeys(row.case.rpartition(", margin at confidence")[0] for row in results.rows)
    for name in (name for name in runs if name):
        curves = []
        for metric in ("missed surface", "false hits", "solved"):
            rows = [row for row in results.select(f"{name}, margin ") if (row.metric, row.unit) == (metric, "%")]
            shares = [Point(float(row.case.split()[-2]), row.value) for row in rows if row.value is not None]
            curves.append(PlotCurve(metric, shares))
        marks = [
            Point(row.value, 100.0 * (1.0 - float(row.metric)), row.metric)
            for row in results.select(f"{name}, margin at confidence")
            if row.value is not None
        ]
        curves.append(PlotCurve("margin at confidence", marks, "points"))
        panel = Panel(name, "margin [mm]", "share [%]", curves, "linear", "log")
        save_plot([panel], out, f"planning-margins-{name}")

"""Missed surface, false hits and solved problems over the margin, on the map of a recording."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt

from splatbot.bench.planning_problems import Problem
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
        results: receives the rows, and the curve of the plot.
        name: name of the run.
        audit: confirmed points of the run.
        field: collision field of its map.
        T_world_base: (4, 4) pose of the arm.
        problems: the problems.
        budget_ms: time of a plan [ms].
    """
    curve = []
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
        curve.append((margin, *row))
    marks = {share: audit.quantile(share) for share in CONSTANTS.confidences}
    for share, margin in marks.items():
        results.add(f"{name}, margin at confidence", f"{share:g}", 1e3 * margin, "mm")
    results.curves.setdefault("margins", {})[name] = (np.array(curve), marks)


def plot_margins(name: str, curve: Array, marks: dict[float, float], out: Path) -> None:
    """Write ``planning-margins-NAME.png``: the three shares over the margin, and the margins at confidences.

    Args:
        name: name of the run.
        curve: (M, 4) margin [m], missed, false hits, solved [%].
        marks: margin [m] by confidence.
        out: a folder.
    """
    figure, axis = plt.subplots(figsize=(6.4, 3.9))
    for column, label, style in ((1, "missed surface", "o-"), (2, "false hits", "s-"), (3, "solved problems", "^-")):
        axis.plot(1e3 * curve[:, 0], np.maximum(curve[:, column], 1e-3), style, markersize=4, label=label)
    for share, margin in marks.items():
        axis.axvline(1e3 * margin, color="0.6", linewidth=0.8, linestyle=":")
        axis.annotate(f"{share:g}", (1e3 * margin, 1.3e-3), fontsize=7, rotation=90, color="0.4")
    axis.set(yscale="log", xlabel="margin [mm]", ylabel="share [%], 0.001 and less at the bottom", title=name)
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    figure.tight_layout()
    figure.savefig(out / f"planning-margins-{name}.png", dpi=130)
    plt.close(figure)

"""Curves of `splatbot bench collision`: error against time."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from splatbot.bench.results import Results


def plot_accuracy(results: Results, out: Path) -> None:
    """Write ``collision-accuracy.png`` and ``.svg``: errors of configurations over n_sigma, of edges over time."""
    figure, axes = plt.subplots(1, 2, figsize=(10, 3.9))
    rows = [row.case for row in results.rows if row.case.startswith("sweep n_sigma") and row.metric == "false hit"]
    most = max(
        (case.split(" on ")[1].split(" Gaussians")[0] for case in rows), key=lambda n: rows_of(rows, n), default=""
    )
    for metric, marker in (("false hit", "o-"), ("false free", "s--")):
        points = [
            (float(row.case.rpartition(": ")[2].split()[0]), row.value)
            for row in results.select(f"sweep n_sigma on {most} ")
            if row.metric == metric and row.value is not None
        ]
        if points:
            axes[0].plot(*zip(*sorted(points), strict=True), marker, label=metric)
    axes[0].axvline(2.0, color="#d1495b", linestyle=":", label="default")
    axes[0].set(title=f"configurations, {most} Gaussians", xlabel="n_sigma", ylabel="%")
    axes[0].set_yscale("symlog", linthresh=1e-3)
    cases = dict.fromkeys(row.case for row in results.select("sweep edges on "))
    for case in cases:
        us, free, hit = (results.find(case, metric) for metric in ("an edge", "false free", "false hit"))
        if us is None or free is None or hit is None:
            continue
        label = case.rpartition(": ")[2]
        axes[1].plot([us], [free], "s", color="#d1495b" if "default" in label else "#2a6f97")
        axes[1].annotate(label, (us, free), textcoords="offset points", xytext=(4, 4), fontsize=7)
    axes[1].set(title="edges of 1 rad", xlabel="us an edge", ylabel="false free [%]")
    axes[1].set_yscale("symlog", linthresh=1e-3)
    for axis in axes:
        axis.grid(alpha=0.3)
    axes[0].legend(fontsize=8)
    figure.tight_layout()
    for suffix in ("png", "svg"):
        figure.savefig(out / f"collision-accuracy.{suffix}", dpi=130)
    plt.close(figure)


def rows_of(cases: list[str], count: str) -> int:
    """Count the cases of a number of Gaussians."""
    return sum(f" on {count} Gaussians" in case for case in cases)

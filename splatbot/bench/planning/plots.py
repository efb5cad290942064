"""The curve of `splatbot bench planning`: cost against time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path

import matplotlib

matplotlib.use("Agg")
import numpy as np
from matplotlib import pyplot as plt

from splatbot.protocols import Array

DEFAULT_MS = 28.0


def plot_cost(histories: Sequence[Array], peers: Mapping[str, Mapping[float, Array]], out: Path) -> None:
    """Write ``planning-cost.png`` and ``.svg``: the mean cost of all problems over time, with peers' at their budgets.

    Args:
        histories: (H, 2) of (seconds, cost [rad]) of each problem.
        peers: costs (P,) [rad] by budget [ms], NaN where unsolved, by name.
        out: a folder.
    """
    figure, axis = plt.subplots(figsize=(6.4, 3.9))
    if histories:
        begin = float(np.percentile([h[0, 0] for h in histories], 95))  # nearly all have a path
        end = max(float(h[-1, 0]) for h in histories)
        at = np.geomspace(begin, max(end, 2 * begin), 200)
        mean = [np.mean([h[h[:, 0] <= t][-1, 1] for h in histories if h[0, 0] <= t]) for t in at]
        axis.plot(1e3 * at, mean, color="#d1495b", label="splatbot")
        axis.axvline(DEFAULT_MS, color="#d1495b", linestyle=":", label="default budget")
    for name, costs in peers.items():
        points = [(ms, float(np.nanmean(c))) for ms, c in sorted(costs.items()) if np.isfinite(c).any()]
        if points:
            axis.plot(*zip(*points, strict=True), "o-", markersize=4, label=name)
    axis.set(xscale="log", xlabel="ms", ylabel="mean cost of solved problems [rad]", title="path cost over time")
    axis.grid(alpha=0.3)
    axis.legend(fontsize=8)
    figure.tight_layout()
    for suffix in ("png", "svg"):
        figure.savefig(out / f"planning-cost.{suffix}", dpi=130)
    plt.close(figure)

"""Plot of `splatbot bench sizing`: utilisation of each resource over the number of robots."""

from __future__ import annotations

from pathlib import Path

import matplotlib

matplotlib.use("Agg")
from matplotlib import pyplot as plt

from splatbot.bench.results import Results


def plot_utilisation(results: Results, out: Path) -> None:
    """Write ``sizing.png`` and ``.svg``: the share of each resource in use on the planned nodes."""
    robots, shares = results.curves["robots"], results.curves["utilisation"]
    figure, axis = plt.subplots(figsize=(7.2, 4.4))
    for name in shares[0]:
        axis.plot(robots, [100 * share[name] for share in shares], label=name)
    axis.axhline(100.0, color="#d1495b", linestyle=":")
    axis.axvline(results.curves["planned"], color="#8d99ae", linestyle=":", label="planned")
    axis.set(xscale="log", yscale="log", xlabel="robots (simulated)", ylabel="utilisation [%]", ylim=(0.1, 1000.0))
    axis.grid(alpha=0.3, which="both")
    axis.legend(fontsize=8, loc="upper left", ncols=2)
    figure.tight_layout()
    for suffix in ("png", "svg"):
        figure.savefig(out / f"sizing.{suffix}", dpi=130)
    plt.close(figure)

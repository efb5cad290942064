"""Quality of held-out views over the seconds of training, a panel per knob."""

from __future__ import annotations

from pathlib import Path

from splatbot.bench.results import Results
from splatbot.report.theme import INK, SERIES, figure, png, styled


@styled
def plot_training(results: Results, out: Path) -> None:
    """Write ``training.png``: PSNR against seconds; the default setting is in grey in each panel."""
    curves = results.curves
    knobs = list(dict.fromkeys(case.split()[0] for case in curves if case != "(default)"))
    fig, axes = figure(max(1, len(knobs)), width=4.2 * max(1, len(knobs)), height=3.4)
    for ax, knob in zip(axes, knobs or [""], strict=True):
        ax.plot(*zip(*curves["(default)"], strict=True), color=INK, linewidth=2.5, label="(default)")
        for color, case in zip(SERIES, [c for c in curves if c.split()[0] == knob], strict=False):
            if curves[case]:
                ax.plot(*zip(*curves[case], strict=True), color=color, marker=".", label=case.partition(" ")[2])
        ax.set_title(knob)
        ax.set_xlabel("time of training [s]")
        ax.set_ylabel("PSNR of held-out views [dB]")
        ax.legend(loc="best")
    (out / "training.png").write_bytes(png(fig))

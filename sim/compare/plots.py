"""Plots of a comparison: errors over the frames of a log, and success of policies in two twins."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes

from splatbot.report.theme import BLUE, GREEN, INK, ORANGE, RED, figure, png, styled
from splatbot.sim.compare.agreement import Agreement, Interval
from splatbot.sim.compare.replay import Replay
from splatbot.sim.compare.views import ViewAgreement


@styled
def frames_plot(views: Sequence[ViewAgreement]) -> bytes | None:
    """Plot depth error, PSNR and silhouette IoU over the frames; held-out frames are rings."""
    if not views:
        return None
    fig, (depth, colour, shape) = figure(3, height=2.8)
    _curve(depth, views, "part_l1_m", 1e3, BLUE, "Gaussians")
    _curve(depth, views, "physics_l1_m", 1e3, ORANGE, "collision geometry")
    _curve(colour, views, "psnr_db", 1.0, BLUE, "Gaussians")
    _curve(shape, views, "iou", 1.0, BLUE, "Gaussians")
    _curve(shape, views, "physics_iou", 1.0, ORANGE, "collision geometry")
    for ax, label in zip((depth, colour, shape), ("depth L1 [mm]", "PSNR [dB]", "silhouette IoU"), strict=True):
        ax.set_xlabel("frame")
        ax.set_ylabel(label)
    depth.set_ylim(bottom=0)
    shape.set_ylim(0, 1.02)
    fig.legend(*depth.get_legend_handles_labels(), loc="outside upper center", ncols=2)
    return png(fig)


@styled
def replay_plot(replay: Replay) -> bytes | None:
    """Plot the difference of the simulated tool pose to the recorded one over the frames."""
    if not replay.errors:
        return None
    fig, axes = figure(2, height=2.4)
    index = [error.index for error in replay.errors]
    for ax, values, label, color in (
        (axes[0], [1e3 * error.position_m for error in replay.errors], "tool position error [mm]", BLUE),
        (axes[1], [np.degrees(error.angle_rad) for error in replay.errors], "tool rotation error [deg]", GREEN),
    ):
        ax.plot(index, values, color=color, linewidth=1.3, marker=".", markersize=4)
        ax.set_ylim(bottom=0)
        ax.set_xlabel("frame")
        ax.set_ylabel(label)
    return png(fig)


@styled
def policies_plot(agreement: Agreement) -> bytes:
    """Plot success in the twin of the map against success in the held-out one, with intervals."""
    fig, (ax,) = figure(width=5.0, height=4.2)
    ax.plot([0, 1], [0, 1], color=INK, linewidth=0.8, linestyle="--")
    for k, score in enumerate(agreement.policies):
        x, y = score.in_map, score.in_held_out
        color = (BLUE, ORANGE, GREEN, RED)[k % 4]
        ax.errorbar(
            _number(x.value), _number(y.value), xerr=_bars(x), yerr=_bars(y), fmt="none", ecolor=color, alpha=0.5
        )
        ax.plot(
            _number(x.value), _number(y.value), marker="osD^v"[k % 5], linestyle="none", color=color, label=score.name
        )
    ax.set_xlim(-0.03, 1.03)
    ax.set_ylim(-0.03, 1.03)
    ax.set_xlabel("success in the twin of the map")
    ax.set_ylabel("success in the held-out twin")
    fig.legend(*ax.get_legend_handles_labels(), loc="outside lower center", ncols=2)
    return png(fig)


def _curve(ax: Axes, views: Sequence[ViewAgreement], name: str, scale: float, color: str, label: str) -> None:
    index = np.array([view.index for view in views])
    values = np.array([_number(getattr(view, name)) for view in views]) * scale
    held = np.array([view.held_out for view in views])
    ax.plot(index, values, color=color, linewidth=1.3, marker=".", markersize=4, label=label)
    ax.plot(index[held], values[held], linestyle="none", marker="o", markersize=6, mfc="none", color=color)


def _number(value: float | None) -> float:
    return np.nan if value is None else value


def _bars(interval: Interval) -> list[list[float]]:
    low, high, value = (_number(x) for x in (interval.low, interval.high, interval.value))
    return [[max(value - low, 0.0)], [max(high - value, 0.0)]]

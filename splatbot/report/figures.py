"""Plots of a run report. Each takes plain rows and returns PNG bytes, or None if there is nothing to plot."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from matplotlib.axes import Axes
from matplotlib.collections import LineCollection
from numpy.typing import NDArray

from splatbot.report.theme import BLUE, GREEN, INK, ORANGE, RED, SERIES, figure, png, styled
from splatbot.results.folder import FrameRow
from splatbot.results.metrics import stage_names
from splatbot.results.scoring import TrajectoryScore
from splatbot.trajectory import Trajectory

_BANDS = {
    "lost": (RED, "lost"),
    "degraded": (ORANGE, "degraded"),
    "skipped": (INK, "unreadable"),
    "dropped": (INK, "dropped"),
}


@styled
def trajectory_plot(trajectory: Trajectory, track: TrajectoryScore | None) -> bytes | None:
    """Plot the trajectory from above and from the side, coloured by its error if there is a reference."""
    if len(trajectory) == 0:
        return None
    fig, axes = figure(2, height=4.0)
    for ax, (i, j) in zip(axes, ((0, 1), (0, 2)), strict=True):
        if track is None:
            _path(ax, trajectory.positions[:, [i, j]], BLUE, "estimate")
            frame = "first camera"
        else:
            _path(ax, track.reference[:, [i, j]], INK, "reference", dashed=True)
            coloured = _coloured_path(ax, track.estimate[:, [i, j]], 1e3 * track.absolute.errors)
            frame = "reference frame"
        ax.set_aspect("equal", adjustable="datalim")
        ax.set_xlabel(f"{'xyz'[i]} [m], {frame}")
        ax.set_ylabel(f"{'xyz'[j]} [m]")
        ax.legend(loc="best")
    if track is not None:
        fig.colorbar(coloured, ax=axes, label="error [mm]", shrink=0.85)
    return png(fig)


@styled
def error_plot(rows: Sequence[FrameRow], track: TrajectoryScore | None) -> bytes | None:
    """Plot the position error of every tracked frame over time, with bands for lost and degraded frames."""
    stamps = [row.stamp for row in rows if row.stamp is not None]
    if track is None or not stamps:
        return None
    fig, (ax,) = figure()
    t0 = stamps[0]
    _bands(ax, rows, t0)
    ate = track.absolute
    ax.plot(ate.stamps - t0, 1e3 * ate.errors, color=BLUE, linewidth=1.3, marker=".", markersize=4)
    ax.axhline(1e3 * ate.rmse, color=GREEN, linewidth=1.2, linestyle="--", label="ATE RMSE")
    ax.set_ylim(0.0, 1.2e3 * max(ate.max, 1e-6))  # leaves space above the curve for the legend
    ax.set_xlabel("time [s]")
    ax.set_ylabel("position error [mm]")
    ax.legend(loc="upper left", ncols=4)
    return png(fig)


@styled
def stages_plot(rows: Sequence[FrameRow]) -> bytes | None:
    """Plot the time of every frame [ms], stacked by stage; the remainder outside all stages is "other"."""
    done = [row for row in rows if row.processed]
    if not done:
        return None
    names = stage_names(done)
    spent = np.array([[row.stage_ms.get(name, 0.0) for name in names] for row in done]).reshape(len(done), len(names))
    other = np.clip([row.ms for row in done] - spent.sum(axis=1), 0.0, None)
    fig, (ax,) = figure(height=3.4)
    x = np.array([row.index for row in done])
    base = np.zeros(len(done))
    for k, (name, values) in enumerate([*zip(names, spent.T, strict=True), ("other", other)]):
        color = INK if name == "other" else SERIES[k % len(SERIES)]
        ax.bar(x, values, bottom=base, width=1.0, color=color, label=name, linewidth=0)
        base = base + values
    # One slow frame, such as the first or a relocalization, must not flatten all others.
    top = max(1.25 * float(np.percentile(base, 98)), 1e-3)
    ax.set_ylim(0, min(top, 1.05 * float(base.max()) + 1e-3))
    ax.set_xlabel("frame")
    ax.set_ylabel("milliseconds")
    fig.legend(*ax.get_legend_handles_labels(), loc="outside right upper")
    return png(fig)


@styled
def gaussians_plot(rows: Sequence[FrameRow]) -> bytes | None:
    """Plot the size of the map over the frames, with keyframes marked."""
    done = [row for row in rows if row.processed]
    if not done:
        return None
    fig, (ax,) = figure(height=2.6)
    x = np.array([row.index for row in done])
    count = np.array([row.gaussians for row in done])
    key = np.array([row.keyframe for row in done])
    ax.fill_between(x, count, color=BLUE, alpha=0.15, linewidth=0)
    ax.plot(x, count, color=BLUE, linewidth=1.4)
    ax.plot(x[key], count[key], linestyle="none", marker="o", markersize=4, color=ORANGE, label="keyframe")
    ax.set_ylim(bottom=0)
    ax.set_xlabel("frame")
    ax.set_ylabel("Gaussians")
    ax.yaxis.set_major_formatter("{x:,.0f}")
    if key.any():
        ax.legend(loc="lower right")
    return png(fig)


def bands(rows: Sequence[FrameRow]) -> list[tuple[str, float, float]]:
    """Return time spans (verdict, from, to) [s] of consecutive frames whose verdict is not "ok".

    A frame's span extends half-way to its neighbours. A frame that could not be read has no stamp and fills the gap
    between its neighbours.
    """
    stamped = [row.stamp for row in rows if row.stamp is not None]
    if not stamped:
        return []
    positions = np.arange(len(rows))
    known = np.array([i for i, row in enumerate(rows) if row.stamp is not None])
    t = np.interp(positions, known, stamped)
    middle = (t[1:] + t[:-1]) / 2.0
    left, right = np.concatenate([t[:1], middle]), np.concatenate([middle, t[-1:]])
    spans: list[tuple[str, float, float]] = []
    for row, start, end in zip(rows, left, right, strict=True):
        if row.verdict == "ok":
            continue
        if spans and spans[-1][0] == row.verdict and spans[-1][2] == start:
            spans[-1] = (row.verdict, spans[-1][1], float(end))
        else:
            spans.append((row.verdict, float(start), float(end)))
    return spans


def _bands(ax: Axes, rows: Sequence[FrameRow], t0: float) -> None:
    named: set[str] = set()
    for verdict, start, end in bands(rows):
        color, label = _BANDS[verdict]
        ax.axvspan(start - t0, end - t0, color=color, alpha=0.25, linewidth=0, label=None if label in named else label)
        named.add(label)


def _path(ax: Axes, points: NDArray[np.float64], color: str, label: str, *, dashed: bool = False) -> None:
    ax.plot(*points.T, color=color, linewidth=1.4, linestyle="--" if dashed else "-", label=label)
    ax.plot(*points[0], marker="o", markersize=5, color=color)


def _coloured_path(ax: Axes, points: NDArray[np.float64], values: NDArray[np.float64]) -> LineCollection:
    segments = np.stack([points[:-1], points[1:]], axis=1)
    lines = LineCollection(list(segments), cmap="plasma", linewidths=2.4, label="estimate")
    lines.set_array(np.maximum(values[:-1], values[1:]))
    lines.set_clim(0.0, max(float(values.max()), 1e-3))
    ax.add_collection(lines)
    ax.autoscale_view()
    return lines

"""One style of the curves of all benchmarks: default setting, units, error bars, labels that do not overlap."""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import Any, Literal

import matplotlib
import numpy as np
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.text import Annotation
from matplotlib.ticker import FixedLocator, FuncFormatter, MaxNLocator, NullLocator
from matplotlib.transforms import Bbox

from splatbot.report.theme import BLUE, GREEN, ORANGE, PURPLE, RED, SERIES

Scale = Literal["linear", "log"]
Style = Literal["joined", "points", "line", "reference"]


@dataclass(frozen=True)
class PlotConstants:
    """Constants of plots.

    Args:
        panel: width and height of a panel [inch].
        columns: most panels side by side.
        dpi: pixels of an inch.
        turns: places around a point that are tried for its label, the nearest first.
        gap: [pt] least distance between a label and other marks.
        nearer: distance of a label from its point, relative to that from the nearest other, above which a line leads
            to its point.
        far: [pt] distance of a label from its point above which a line leads to it.
        ticks: most numbers at an axis.
        narrow: quotient of the limits of a logarithmic axis below which its numbers are evenly spaced.
    """

    panel: tuple[float, float] = (4.2, 3.6)
    columns: int = 3
    dpi: int = 200
    turns: int = 4000
    gap: float = 1.0
    nearer: float = 0.8
    far: float = 14.0
    ticks: int = 6
    narrow: float = 4.0


CONSTANTS = PlotConstants()

DEFAULT_COLOR = RED
_COLORS = (BLUE, ORANGE, GREEN, PURPLE, *SERIES[4:])
_MARKERS = "os^Dv<>P"
_INK = "#20242a"  # on white, which is legible on light and dark pages
_STYLE: dict[Any, Any] = {
    "font.family": "DejaVu Sans",
    "font.size": 10.5,
    "axes.titlesize": 11.5,
    "xtick.labelsize": 9.5,
    "ytick.labelsize": 9.5,
    "text.color": _INK,
    "axes.labelcolor": _INK,
    "axes.edgecolor": _INK,
    "xtick.color": _INK,
    "ytick.color": _INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
    "legend.fontsize": 9.5,
    "svg.hashsalt": "splatbot",  # equal results give equal files
}


@dataclass(frozen=True)
class Point:
    """A measured setting.

    Args:
        x, y: its place in the units of the axes. If one is not finite, the point is left out.
        label: name of the setting. Equal labels of a panel are written once.
        default: whether it is the default setting.
        low, high: ends of the error bar, in the unit of y. If None, there is no bar.
    """

    x: float
    y: float
    label: str = ""
    default: bool = False
    low: float | None = None
    high: float | None = None


@dataclass(frozen=True)
class PlotCurve:
    """Points of one method.

    Args:
        name: in the legend.
        points: its settings, in the order of the knob.
        style: "joined" by a line, "points" alone, a "line" without markers, or a "reference" in grey, dotted.
    """

    name: str
    points: Sequence[Point]
    style: Style = "joined"


@dataclass(frozen=True)
class Panel:
    """Curves over the same axes.

    A logarithmic axis of y with a zero ends at zero, and its lowest part is linear.

    Args:
        title: above the panel.
        x, y: names of the axes with units.
        curves: the methods.
        x_scale, y_scale: "linear" or "log".
    """

    title: str
    x: str
    y: str
    curves: Sequence[PlotCurve]
    x_scale: Scale = "linear"
    y_scale: Scale = "linear"


@matplotlib.rc_context(_STYLE)
def save_plot(panels: Sequence[Panel], folder: Path, name: str) -> None:
    """Write the panels side by side as ``NAME.png`` and ``NAME.svg``; without a point, write nothing."""
    if not any(_finite(curve, panel) for panel in panels for curve in panel.curves):
        return
    figure = draw(panels)
    figure.savefig(folder / f"{name}.png", dpi=CONSTANTS.dpi)
    figure.savefig(folder / f"{name}.svg", metadata={"Date": None})


@matplotlib.rc_context(_STYLE)
def draw(panels: Sequence[Panel]) -> Figure:
    """Draw the panels in rows of at most three, with one legend below, on white."""
    columns = min(len(panels), CONSTANTS.columns)
    rows = math.ceil(len(panels) / columns)
    size = (CONSTANTS.panel[0] * columns, CONSTANTS.panel[1] * rows)
    figure = Figure(figsize=size, dpi=CONSTANTS.dpi, layout="constrained", facecolor="white")
    FigureCanvasAgg(figure)
    axes = [figure.add_subplot(rows, columns, k + 1) for k in range(len(panels))]
    names = dict.fromkeys(curve.name for panel in panels for curve in panel.curves)
    styles = {name: (_COLORS[k % len(_COLORS)], _MARKERS[k % len(_MARKERS)]) for k, name in enumerate(names)}
    handles: dict[str, Artist] = {}
    for axis, panel in zip(axes, panels, strict=True):
        handles |= _draw_panel(axis, panel, styles)
    _add_legend(figure, handles)
    figure.draw_without_rendering()  # settles the layout, which labels must not change
    figure.set_layout_engine("none")
    for axis, panel in zip(axes, panels, strict=True):
        _add_labels(axis, panel)
    return figure


def _draw_panel(axis: Axes, panel: Panel, styles: dict[str, tuple[str, str]]) -> dict[str, Artist]:
    """Draw axes and curves; return the entries of the legend."""
    handles: dict[str, Artist] = {}
    axis.set(title=panel.title, xlabel=panel.x, ylabel=panel.y)
    axis.grid(color="#d8dce2", linewidth=0.6)
    axis.set_axisbelow(True)
    every: list[Point] = []
    for curve in panel.curves:
        points = _finite(curve, panel)
        if not points:
            continue
        every += points
        color, marker = styles[curve.name]
        if curve.style == "reference":
            color = "#8d99ae"
        handles[curve.name] = axis.plot(
            [p.x for p in points],
            [p.y for p in points],
            marker=marker if curve.style in ("joined", "points") else "none",
            linestyle={"points": "none", "reference": ":"}.get(curve.style, "-"),
            color=color,
            markersize=5,
            linewidth=1.6,
            clip_on=False,
        )[0]
        for p in points:
            if p.low is not None and p.high is not None:
                axis.errorbar([p.x], [p.y], [[p.y - p.low], [p.high - p.y]], fmt="none", ecolor=color, capsize=3)
    chosen = [p for p in every if p.default]
    if chosen:
        x, y = [p.x for p in chosen], [p.y for p in chosen]
        (handles["default"],) = axis.plot(
            x, y, "o", color=DEFAULT_COLOR, markersize=10, markeredgecolor="white", clip_on=False, zorder=5
        )
    _scale(axis.xaxis, panel.x_scale, [p.x for p in every])
    _scale(axis.yaxis, panel.y_scale, [value for p in every for value in (p.y, p.low, p.high) if value is not None])
    return handles


def _finite(curve: PlotCurve, panel: Panel) -> list[Point]:
    """Return the points that the axes can show."""

    def shown(p: Point) -> bool:
        return math.isfinite(p.x) and math.isfinite(p.y) and (panel.x_scale == "linear" or p.x > 0.0)

    return [p for p in curve.points if shown(p)]


def _scale(axis: Axis, scale: Scale, values: Sequence[float]) -> None:
    """Set scale, limits and numbers of an axis for its values; the limits leave room for labels."""
    above = [value for value in values if value > 0.0]
    owner, name = axis.axes, axis.axis_name  # type: ignore[attr-defined]
    limits = getattr(owner, f"set_{name}lim")
    if scale == "linear" or not above:
        low, high = (min(values), max(values)) if values else (0.0, 1.0)
        room = 0.12 * (high - low) or 0.12 * abs(high) or 1.0
        limits(low - room if low < 0.0 or low > room else 0.0, high + room)
        axis.set_major_locator(MaxNLocator(CONSTANTS.ticks - 1, steps=(1, 2, 5, 10)))
    else:
        low, high = min(above), max(above)
        room = max((high / low) ** 0.15, 1.15)
        if min(values) < low:
            decade = 10.0 ** math.floor(math.log10(low))
            getattr(owner, f"set_{name}scale")("symlog", linthresh=decade, linscale=0.6)
            limits(0.0, high * room)
            axis.set_major_locator(FixedLocator([0.0, *_decades(decade, high * room)]))
        else:
            getattr(owner, f"set_{name}scale")("log")
            limits(low / room, high * room)
            axis.set_major_locator(FixedLocator(_log_ticks(low / room, high * room)))
    axis.set_minor_locator(NullLocator())
    axis.set_major_formatter(FuncFormatter(lambda value, _: f"{value:.6g}"))


def _log_ticks(low: float, high: float) -> list[float]:
    """Return numbers within the limits of a logarithmic axis: even ones, 1-2-5, or powers of ten."""
    if high / low < CONSTANTS.narrow:
        return [
            t for t in MaxNLocator(CONSTANTS.ticks - 1, steps=(1, 2, 5, 10)).tick_values(low, high) if low <= t <= high
        ]
    powers = range(math.floor(math.log10(low)), math.ceil(math.log10(high)) + 1)
    ticks = [digit * 10.0**power for power in powers for digit in (1, 2, 5)]
    inside = [t for t in ticks if low <= t <= high]
    return inside if len(inside) <= CONSTANTS.ticks else _decades(low, high)


def _decades(low: float, high: float) -> list[float]:
    """Return powers of ten within limits, each n-th where there are many."""
    powers = list(range(math.ceil(math.log10(low) - 1e-9), math.floor(math.log10(high) + 1e-9) + 1))
    return [10.0**power for power in powers[:: 1 + len(powers) // (CONSTANTS.ticks + 1)]]


def _add_legend(figure: Figure, handles: dict[str, Artist]) -> None:
    """Put the legend below the panels, in as many columns as fit."""
    for columns in range(len(handles), 0, -1):
        legend = figure.legend(
            list(handles.values()), list(handles), loc="outside lower center", ncols=columns, columnspacing=1.2
        )
        if columns == 1 or legend.get_window_extent().width <= figure.bbox.width:
            return
        legend.remove()


def _add_labels(axis: Axes, panel: Panel) -> None:
    """Write each label once, at a free place near its point; where another point is nearer, a line leads to it."""
    points = [p for curve in panel.curves for p in _finite(curve, panel)]
    places = axis.transData.transform([(p.x, p.y) for p in points]) if points else np.zeros((0, 2))
    taken = list(_obstacles(axis, points))
    for label in dict.fromkeys(p.label for p in points if p.label):
        at = places[next(k for k, p in enumerate(points) if p.label == label)]
        text = axis.annotate(label, at, xycoords="figure pixels", fontsize=9.5, ha="center", va="center")
        boxes = _free_boxes(axis, text, at, taken)
        if not len(boxes):
            text.remove()
            continue
        others = places[np.abs(places - at).max(axis=1) > 1.0]
        own, least = _distance(boxes, at), np.min([_distance(boxes, other) for other in others], axis=0, initial=np.inf)
        clear = own < CONSTANTS.nearer * least
        best = boxes[int(np.argmax(clear))]
        text.set_position((best[:2] + best[2:]) / 2)
        taken.append(Bbox.from_extents(*best))
        if not clear.any() or own[int(np.argmax(clear))] > CONSTANTS.far * _pixels(axis):
            ends = axis.transData.inverted().transform([at, np.clip(at, best[:2], best[2:])])
            axis.add_line(Line2D(ends[:, 0], ends[:, 1], color=_INK, linewidth=0.7, zorder=1))


def _obstacles(axis: Axes, points: Iterable[Point]) -> Iterable[Bbox]:
    """Return boxes [px] that labels avoid: markers, error bars, and pieces of the lines."""
    half = 5.0 * _pixels(axis)
    for p in points:
        x, y = axis.transData.transform((p.x, p.y))
        yield Bbox([[x - half, y - half], [x + half, y + half]])
        if p.low is not None and p.high is not None:
            (_, low), (_, high) = axis.transData.transform([(p.x, p.low), (p.x, p.high)])
            yield Bbox([[x - 1, low], [x + 1, high]])
    for line in axis.get_lines():
        if line.get_linestyle() != "None":
            corners = line.get_transform().transform(line.get_xydata())
            for a, b in pairwise(corners):
                for x, y in np.linspace(a, b, max(2, int(np.hypot(*(b - a)) / (2 * half)))):
                    yield Bbox([[x - 1, y - 1], [x + 1, y + 1]])


def _free_boxes(axis: Axes, text: Annotation, at: Any, taken: Sequence[Bbox]) -> Any:
    """Return boxes (N, 4) [px] of free places for a text on a spiral around a point, the nearest first."""
    box, room, gap = text.get_window_extent(), axis.get_window_extent(), CONSTANTS.gap * _pixels(axis)
    half = np.array([box.width, box.height]) / 2 + gap
    full = np.array([b.extents for b in taken])
    step = np.arange(1, CONSTANTS.turns)
    angle, radius = 2.4 * step, 2.0 * _pixels(axis) * np.sqrt(step)  # golden angle
    # A text is wide: the spiral is an ellipse.
    tried = at + np.stack([1.6 * radius * np.cos(angle), radius * np.sin(angle)], axis=1)
    low, high = tried - half, tried + half
    free = (low >= [room.x0, room.y0]).all(axis=1) & (high <= [room.x1, room.y1]).all(axis=1)
    apart = (low[:, None] >= full[:, 2:]) | (high[:, None] <= full[:, :2])
    free &= apart.any(axis=2).all(axis=1)
    return np.concatenate([low + gap, high - gap], axis=1)[free]


def _distance(boxes: Any, point: Any) -> Any:
    """Return the distances (N,) [px] of boxes (N, 4) from a point (2,)."""
    return np.linalg.norm(np.maximum(np.maximum(boxes[:, :2] - point, point - boxes[:, 2:]), 0.0), axis=1)


def _pixels(axis: Axes) -> float:
    """Return the pixels of a point (1/72 inch)."""
    return axis.get_figure(root=True).dpi / 72.0  # type: ignore[union-attr]

"""Colours and figure styles that are legible on light and dark pages."""

from __future__ import annotations

import base64
import io
from collections.abc import Callable
from functools import wraps
from typing import Any, ParamSpec, TypeVar

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

P = ParamSpec("P")
R = TypeVar("R")

INK = "#838b96"  # mid grey: figures are transparent and must be legible on light and dark pages
GRID = "#838b9640"
BLUE, ORANGE, GREEN, RED, PURPLE, TEAL = "#3f86d0", "#e0912f", "#3fa372", "#d9515f", "#8f74d1", "#2ba5a5"
SERIES = (BLUE, ORANGE, GREEN, PURPLE, TEAL, "#c2699e", "#a3893c", "#6d9bb8", "#b3724f", "#7fa650")

_STYLE: dict[Any, Any] = {
    "font.family": "sans-serif",
    "font.size": 9.5,
    "text.color": INK,
    "axes.labelcolor": INK,
    "axes.edgecolor": GRID,
    "xtick.color": INK,
    "ytick.color": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "legend.frameon": False,
}


def styled(plot: Callable[P, R]) -> Callable[P, R]:
    """Decorate a plotting function so that it runs in this theme without changing matplotlib's global settings."""

    @wraps(plot)
    def inner(*args: P.args, **kwargs: P.kwargs) -> R:
        with matplotlib.rc_context(_STYLE):
            return plot(*args, **kwargs)

    return inner


def figure(columns: int = 1, *, width: float = 9.0, height: float = 3.0) -> tuple[Figure, list[Axes]]:
    """Create a figure of ``columns`` plots side by side, ``width`` x ``height`` [inch]."""
    fig = Figure(figsize=(width, height), layout="constrained")
    FigureCanvasAgg(fig)
    axes = [fig.add_subplot(1, columns, i + 1) for i in range(columns)]
    for ax in axes:
        ax.set_facecolor("none")
        ax.grid(color=GRID, linewidth=0.6)
        ax.set_axisbelow(True)
    return fig, axes


def png(fig: Figure, *, dpi: int = 140) -> bytes:
    """Encode the figure as a PNG with a transparent background.

    ``Figure.savefig`` draws each figure twice, the first time without pixels; here the only draw computes the layout.
    """
    fig.set_dpi(dpi)
    for patch in (fig.patch, *(ax.patch for ax in fig.axes)):
        patch.set_facecolor("none")
        patch.set_edgecolor("none")
    buffer = io.BytesIO()
    FigureCanvasAgg(fig).print_png(buffer)
    return buffer.getvalue()


def data_uri(image: bytes) -> str:
    """Encode a PNG as a data URI."""
    return "data:image/png;base64," + base64.b64encode(image).decode()

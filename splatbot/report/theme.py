"""Colours and figures that read well on a light and on a dark page."""

from __future__ import annotations

import base64
import io

import matplotlib
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure

INK = "#838b96"  # grey of middling lightness: figures are transparent and must show on both pages
GRID = "#838b9640"
BLUE, ORANGE, GREEN, RED, PURPLE, TEAL = "#3f86d0", "#e0912f", "#3fa372", "#d9515f", "#8f74d1", "#2ba5a5"
SERIES = (BLUE, ORANGE, GREEN, PURPLE, TEAL, "#c2699e", "#a3893c", "#6d9bb8", "#b3724f", "#7fa650")

_STYLE = {
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


def figure(columns: int = 1, *, width: float = 9.0, height: float = 3.0) -> tuple[Figure, list[Axes]]:
    """A figure of ``columns`` plots side by side, ``width`` x ``height`` [inch]; no global matplotlib state."""
    with matplotlib.rc_context(_STYLE):
        fig = Figure(figsize=(width, height), layout="constrained")
        FigureCanvasAgg(fig)
        axes = [fig.add_subplot(1, columns, i + 1) for i in range(columns)]
    for ax in axes:
        ax.set_facecolor("none")
        ax.grid(color=GRID, linewidth=0.6)
        ax.set_axisbelow(True)
    return fig, axes


def png(fig: Figure, *, dpi: int = 140) -> bytes:
    """The figure as PNG, its background transparent."""
    buffer = io.BytesIO()
    with matplotlib.rc_context(_STYLE):
        fig.savefig(buffer, format="png", dpi=dpi, transparent=True)
    return buffer.getvalue()


def data_uri(image: bytes) -> str:
    """A PNG as the address of an inline image."""
    return "data:image/png;base64," + base64.b64encode(image).decode()

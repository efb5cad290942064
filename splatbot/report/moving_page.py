"""Self-contained pages with an animated 3D view that can be rotated, played, stepped and scrubbed."""

from __future__ import annotations

import base64
import html
import json
from collections.abc import Mapping, Sequence
from importlib import resources
from typing import Any

import numpy as np
from numpy.typing import NDArray


def moving_page(
    title: str,
    facts: str,
    data: Mapping[str, Any],
    script: str,
    *,
    legend: Sequence[tuple[str, str]],
    curve: bool = False,
    toggle: str | None = None,
) -> str:
    """Return the page: a canvas, time controls, and the two scripts that draw.

    Args:
        title: heading.
        facts: text next to the heading.
        data: for the scripts. ``stage.js`` uses ``times`` [s], ``middle`` (3,), ``distance`` [m] and
            ``yaw`` [rad].
        script: file in this folder that draws one time step; see ``stage.js``.
        legend: name and CSS colour of each part that is drawn.
        curve: add a canvas for curves over time below the view.
        toggle: label of a checkbox, which the script reads.
    """
    folder = resources.files("splatbot.report")
    own, stage = (folder.joinpath(name).read_text(encoding="utf-8") for name in (script, "stage.js"))
    parts = "".join(f'<li><i style="background: {color}"></i>{html.escape(name)}</li>' for name, color in legend)
    chart = '<canvas id="curve" title="click a moment"></canvas>\n' if curve else ""
    box = f'<label><input id="toggle" type="checkbox"> {html.escape(toggle)}</label>\n' if toggle else ""
    return f"""<!doctype html>
<html lang="en"><head><meta charset="utf-8"><title>{html.escape(title)}</title>
<meta name="viewport" content="width=device-width, initial-scale=1"><style>
:root {{ color-scheme: light dark; --page: #eef0f3; --ink: #1d2430; --line: #9aa3ae; --curve: #2467b3; }}
@media (prefers-color-scheme: dark) {{ :root {{ --page: #16181d; --ink: #e8e8ea; --line: #555; --curve: #7ab7ff; }} }}
body {{ margin: 0; font: 14px system-ui, sans-serif; background: var(--page); color: var(--ink); height: 100dvh;
  display: flex; flex-direction: column; }}
header, footer {{ padding: 8px 14px; overflow-wrap: anywhere; }}
#legend {{ display: flex; flex-wrap: wrap; gap: 2px 16px; margin: 0; padding: 0 14px 6px; list-style: none; }}
#legend i {{ display: inline-block; width: 12px; height: 12px; margin-right: 6px; border-radius: 3px; }}
#view {{ flex: 1; min-height: 0; width: 100vw; display: block; touch-action: none; }}
#curve {{ height: 120px; width: calc(100vw - 28px); margin: 0 14px; cursor: pointer; }}
footer {{ display: flex; flex-wrap: wrap; gap: 12px; align-items: center; }}
input[type="range"] {{ flex: 1; min-width: 8em; }} #play {{ width: 5em; }}
</style></head><body>
<header><b>{html.escape(title)}</b> &nbsp; {html.escape(facts)}</header>
<ul id="legend">{parts}</ul>
<canvas id="view"></canvas>
{chart}<footer><button id="back" title="one step back">&#9664;</button><button id="play">play</button>
<button id="on" title="one step forward">&#9654;</button><input id="time" type="range" min="0" value="0">
<span id="label"></span>{box}</footer>
<script type="application/json" id="data">{json.dumps(data)}</script>
<script>{own}</script>
<script>{stage}</script>
</body></html>
"""


def packed(values: NDArray[np.generic], kind: type) -> str:
    """Encode an array as base64 text of its little-endian values."""
    return base64.b64encode(np.ascontiguousarray(values, dtype=kind).tobytes()).decode()


def css(color: Sequence[float]) -> str:
    """Return a colour in 0..1 as CSS."""
    return "rgb({}, {}, {})".format(*(round(255 * float(part)) for part in color))


MAP_IN_COLORS = ("map, in its own colours", "linear-gradient(90deg, #8d5b3a, #d8c9a8, #3d6f8f)")
"""Row of a legend for the points of a map."""


def evenly_spaced(count: int, most: int) -> NDArray[np.int64]:
    """Return at most ``most`` evenly spaced indices below ``count``."""
    return np.linspace(0, count - 1, min(count, most)).astype(np.int64)


def bytes_of(colors: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Convert colours in 0..1 to 0..255."""
    return (255 * np.clip(colors, 0, 1)).astype(np.uint8)

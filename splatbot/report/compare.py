"""The HTML page that compares two maps, with all content inline."""

from __future__ import annotations

import base64
import html
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.rasterize.views import colorize, depth_limits
from splatbot.report.images import DIFFERENCE_GAIN, colour_png, difference_png
from splatbot.report.parts import document, note, pictures, section, table, tiles
from splatbot.results.units import count, decibels, megabytes, millimetres, number, percent
from splatbot.training.comparison import ComparedView

_WIDEST = 720  # [px] of an image under a slider
_JPEG_QUALITY = 88
_DEPTH_GAIN = 20.0  # a difference of a twentieth of the depth is white

_STYLE = """<style>
.swipes { display: grid; grid-template-columns: repeat(auto-fit, minmax(min(100%, 300px), 1fr)); gap: 12px;
  margin: 0 0 12px; }
.swipes figure { margin: 0; }
.swipe { position: relative; border-radius: 5px; overflow: hidden; }
.swipe img { width: 100%; }
.swipe img + img { position: absolute; inset: 0; height: 100%; clip-path: inset(0 0 0 var(--at)); }
.swipe::after { content: ""; position: absolute; top: 0; bottom: 0; left: calc(var(--at) - 1px); width: 2px;
  background: #fff; box-shadow: 0 0 3px #000; pointer-events: none; }
.swipe b { position: absolute; top: 6px; padding: 0 7px; border-radius: 4px; background: #000a; color: #fff;
  font-size: 13px; }
.swipe b:first-of-type { left: 6px; }
.swipe b:last-of-type { right: 6px; }
.swipe input { position: absolute; inset: 0; width: 100%; height: 100%; margin: 0; opacity: 0; cursor: ew-resize;
  touch-action: pan-y; z-index: 1; }
.swipe:focus-within { outline: 2px solid var(--accent); outline-offset: 2px; }
</style>
"""


class PageMap(NamedTuple):
    """A map of the page.

    Args:
        name: path that the user gave.
        gaussians: number of them.
        sh_degree: of its colours.
        file_bytes: size of its file.
    """

    name: str
    gaussians: int
    sh_degree: int
    file_bytes: int


def compare_html(
    a: PageMap, b: PageMap, views: Sequence[ComparedView], means: Mapping[str, float | None], notes: Sequence[str]
) -> str:
    """Return the page.

    Args:
        a, b: the maps.
        views: compared ones, at least one.
        means: of the scores of the views, see :func:`splatbot.training.comparison.summary`.
        notes: reasons why the figures mean little.
    """
    parts = [
        _STYLE,
        *(f'<section class="banner"><b>{html.escape(text)}</b></section>\n' for text in notes),
        tiles(
            [
                (decibels(means["psnr_db"]), "PSNR of B against A"),
                (number(means["ssim"], 3), "SSIM of B against A"),
                (percent(b.gaussians / max(a.gaussians, 1)), "Gaussians of B, of those of A"),
                (percent(b.file_bytes / max(a.file_bytes, 1)), "file of B, of that of A"),
            ]
        ),
        section(
            "Maps",
            table(("", "A", "B"), comparison_rows(a, b, means)),
            note(f"Means over {len(views)} views. Equal images have no PSNR. Drag a slider to see B in place of A."),
        ),
        *(section(html.escape(f"View {view.name}"), _view(view)) for view in views),
    ]
    return document("Two maps", f"A: {a.name} · B: {b.name}", parts)


def comparison_rows(a: PageMap, b: PageMap, means: Mapping[str, float | None]) -> list[tuple[str, str, str]]:
    """Return the table of two maps: a name, and the values of A and of B."""
    rows = [
        ("map", a.name, b.name),
        ("Gaussians", count(a.gaussians), count(b.gaussians)),
        ("SH degree", str(a.sh_degree), str(b.sh_degree)),
        ("file", megabytes(a.file_bytes), megabytes(b.file_bytes)),
        ("pixels covered", percent(means["covered_a"]), percent(means["covered_b"])),
    ]
    if "psnr_a_db" in means:
        rows += [
            ("PSNR against the recording", decibels(means["psnr_a_db"]), decibels(means["psnr_b_db"])),
            ("SSIM against the recording", number(means["ssim_a"], 3), number(means["ssim_b"], 3)),
        ]
    if "depth_error_a" in means:
        of_a, of_b = (millimetres(means[f"depth_error_{name}"]) for name in ("a", "b"))
        rows += [
            ("median error to measured depth", of_a, of_b),
            ("measured pixels covered", percent(means["measured_a"]), percent(means["measured_b"])),
        ]
    return rows


def _view(view: ComparedView) -> str:
    span = depth_limits(view.a.depth)
    depth_a, depth_b = (colorize(seen.depth, "depth", depth_range=span) for seen in (view.a, view.b))
    text = f"{decibels(view.scores['psnr_db'])}, SSIM {number(view.scores['ssim'], 3)}"
    swipes = _swipe(view.a.rgb, view.b.rgb, f"colour: B against A {text}")
    swipes += _swipe(depth_a, depth_b, f"depth: {span[0]:.2f} to {span[1]:.2f} m, red is near")
    shown = [
        (difference_png(view.a.rgb, view.b.rgb), f"A and B, difference times {DIFFERENCE_GAIN:g}"),
        (
            colour_png(_depth_difference(view)),
            f"difference of depth, white from {100 / _DEPTH_GAIN:g} %, grey: one map only",
        ),
    ]
    if view.recorded is not None:
        of_a, of_b = (decibels(view.scores[f"psnr_{name}_db"]) for name in ("a", "b"))
        shown += [
            (colour_png(view.recorded), "recorded"),
            (difference_png(view.a.rgb, view.recorded), f"A and the recording, {of_a}"),
            (difference_png(view.b.rgb, view.recorded), f"B and the recording, {of_b}"),
        ]
    return f'<div class="swipes">{swipes}</div>\n{pictures(shown)}'


def _swipe(a: NDArray[np.uint8], b: NDArray[np.uint8], caption: str) -> str:
    """Return two images on top of each other with a slider between them."""
    text = html.escape(caption)
    return (
        '<figure><div class="swipe" style="--at:50%">'
        f'<img alt="A, {text}" src="{_jpeg(a)}"><img alt="B, {text}" src="{_jpeg(b)}"><b>A</b><b>B</b>'
        '<input type="range" min="0" max="100" value="50" step="0.1" '
        f'aria-label="A left, B right; {text}" '
        "oninput=\"this.parentNode.style.setProperty('--at', this.value + '%')\"></div>"
        f"<figcaption>{text}</figcaption></figure>"
    )


def _jpeg(rgb: NDArray[np.uint8]) -> str:
    """Return an image (H, W, 3) as a data URI, at most 720 pixels wide."""
    height, width = rgb.shape[:2]
    if width > _WIDEST:
        size = (_WIDEST, max(round(height * _WIDEST / width), 1))
        rgb = np.asarray(cv2.resize(rgb, size, interpolation=cv2.INTER_AREA), dtype=np.uint8)
    _, data = cv2.imencode(".jpg", np.ascontiguousarray(rgb[..., ::-1]), [cv2.IMWRITE_JPEG_QUALITY, _JPEG_QUALITY])
    return "data:image/jpeg;base64," + base64.b64encode(bytes(data)).decode()


def _depth_difference(view: ComparedView) -> NDArray[np.uint8]:
    """Return the relative difference of depth as an image; grey where only one map has depth."""
    both = view.a.covered & view.b.covered
    share = np.zeros(both.shape, np.float32)
    share[both] = np.abs(view.b.depth[both] - view.a.depth[both]) / view.a.depth[both]
    levels = np.clip(255.0 * _DEPTH_GAIN * share, 0, 255).astype(np.uint8)
    image = cv2.applyColorMap(levels, cv2.COLORMAP_INFERNO)[..., ::-1].astype(np.uint8)
    image[view.a.covered != view.b.covered] = 128
    return np.ascontiguousarray(image)


def to_json(
    a: PageMap, b: PageMap, views: Sequence[ComparedView], means: Mapping[str, float | None], notes: Sequence[str]
) -> dict[str, Any]:
    """Return the figures of the page for JSON."""
    return {
        "a": a._asdict(),
        "b": b._asdict(),
        "means": dict(means),
        "views": [{"name": view.name, **view.scores} for view in views],
        "notes": list(notes),
    }

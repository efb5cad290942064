"""The style of plots: no text overlaps another or leaves the figure, the default is marked, zeros and NaN are shown."""

from __future__ import annotations

import functools
import itertools
import math
from pathlib import Path

import cv2
import matplotlib
import numpy as np
import pytest
from matplotlib.colors import same_color
from matplotlib.figure import Figure
from matplotlib.text import Text

from splatbot.bench.plots import DEFAULT_COLOR, Panel, PlotCurve, Point, draw, save_plot

LINEAR = ("t", "x [m]", "y [m]")


def curve(name: str, values: list[tuple[float, float, str]], default: str = "") -> PlotCurve:
    return PlotCurve(name, [Point(x, y, label, default=label == default) for x, y, label in values])


BUDGETS = ("30 ms", "100 ms", "300 ms", "1000 ms")
LOGS = {
    "corridor": ((14.5, 25.3, 30.8, 37.2), (0.085, 0.075, 0.053, 0.051)),
    "tabletop": ((24.0, 44.5, 50.0, 60.0), (0.035, 0.037, 0.031, 0.027)),
    "wall_soft": ((10.1, 9.6, 15.1, 22.2), (0.26, 0.16, 0.16, 0.14)),
    "room": ((21.3, 44.0, 56.0, 70.0), (0.21, 0.15, 0.14, 0.13)),
    "room #2": ((18.3, 42.0, 46.0, 60.0), (0.90, 0.52, 0.66, 0.61)),
}
TRACKING = [curve(name, list(zip(x, y, BUDGETS, strict=True)), "100 ms") for name, (x, y) in LOGS.items()]
EDGES = [
    PlotCurve("certified", [Point(9.4, 0.0, "1 mm", True, 0.0, 0.0035), Point(9.0, 0.0, "3 mm", False, 0.0, 0.0035)]),
    curve(
        "sampled", [(1.4, 0.3, "4 samples"), (2.0, 0.06, "8"), (4.6, 0.0045, "16"), (7.3, 0.0, "32"), (14.8, 0.0, "64")]
    ),
]
PLANS = [
    PlotCurve(
        "splatbot",
        [
            Point(x, y, f"{x:g} ms{note}", x == 28, y - 0.03, y + 0.03)
            for x, y, note in (
                (1.0, 5.458, ", 97.6 % solved"),
                (3.0, 5.372, ", 99.6 % solved"),
                (10.0, 5.300, ""),
                (28.0, 5.268, ""),
                (100.0, 5.253, ""),
                (1000.0, 5.245, ""),
            )
        ],
    ),
    curve("OMPL AORRTC, field", [(28.0, 5.37, ""), (100.0, 5.3, ""), (1000.0, 5.26, "")]),
    curve("OMPL BITstar, field", [(28.0, 7.37, ""), (100.0, 7.06, ""), (1000.0, 6.94, "")]),
]
PANELS = {
    "tracking": Panel("Tracking", "time of a frame, median [ms]", "error, RMSE [mm]", TRACKING, "log", "log"),
    "collision": Panel("Edges", "time of an edge [µs]", "missed collisions [%]", EDGES, "log", "log"),
    "planning": Panel("Planning", "time budget [ms]", "path length, mean [rad]", PLANS, "log"),
    "equal points": Panel(*LINEAR, [curve("a", [(1.0, 1.0, f"setting {k}") for k in range(8)])]),
    "one point": Panel(*LINEAR, [curve("a", [(3.0, 7.0, "only")], "only")], "log", "log"),
    "a point at zero": Panel(*LINEAR, [curve("a", [(0.0, 0.0, "nothing")])]),
    "zeros only": Panel(*LINEAR, [curve("a", [(1.0, 0.0, "8"), (2.0, 0.0, "16")], "8")], "log", "log"),
    "a zero": Panel(*LINEAR, [curve("a", [(1.0, 0.0, "8"), (2.0, 1e-7, "16"), (3.0, 90.0, "32")])], "log", "log"),
    "NaN": Panel(*LINEAR, [curve("a", [(1.0, math.nan, "lost"), (2.0, 1.0, "kept"), (math.inf, 1.0, "far")])]),
    "corners": Panel(*LINEAR, [curve("a", [(x, y, f"corner {x} {y}") for x in (0, 1) for y in (0, 1)])]),
    "nearly equal": Panel(*LINEAR, [curve("a", [(100.0, 1.0, "one"), (100.001, 1.0001, "two")])], "log", "log"),
    "nine decades": Panel(*LINEAR, [curve("a", [(10.0**k, 10.0**-k, f"{k}") for k in range(-4, 6)])], "log", "log"),
    "negative": Panel(*LINEAR, [curve("a", [(-2.0, -5.0, "low"), (4.0, 3.0, "high")])]),
    "long names": Panel(*LINEAR, [curve(f"a tracker with a long name {k}", [(k, k, f"{k}")]) for k in range(9)]),
}


@functools.cache
def drawn(name: str) -> Figure:
    return draw([PANELS[name]])


def texts(figure: Figure) -> list[Text]:
    """Return all texts that are drawn, numbers of axes and legends included."""
    figure.draw_without_rendering()
    found = [t for t in figure.findobj(Text) if isinstance(t, Text) and t.get_visible() and t.get_text().strip()]
    for axis in figure.axes:
        for side, (low, high) in ((axis.xaxis, sorted(axis.get_xlim())), (axis.yaxis, sorted(axis.get_ylim()))):
            for tick in [*side.get_major_ticks(), *side.get_minor_ticks()]:
                if not low <= tick.get_loc() <= high:  # matplotlib does not draw these
                    found = [t for t in found if t not in (tick.label1, tick.label2)]
    return found


def labels(figure: Figure) -> list[str]:
    return [t.get_text() for t in figure.axes[0].texts]


@pytest.mark.parametrize("name", PANELS)
def test_no_text_overlaps_another_or_leaves_the_figure(name: str) -> None:
    figure = drawn(name)
    boxes = {text: text.get_window_extent() for text in texts(figure)}
    assert len(boxes) >= 5
    for text, box in boxes.items():
        assert box.x0 >= figure.bbox.x0, text
        assert box.y0 >= figure.bbox.y0, text
        assert box.x1 <= figure.bbox.x1, text
        assert box.y1 <= figure.bbox.y1, text
    for a, b in itertools.combinations(boxes, 2):
        assert not boxes[a].overlaps(boxes[b]), (a, b)


@pytest.mark.parametrize("name", PANELS)
def test_each_setting_that_can_be_shown_has_one_label(name: str) -> None:
    points = [p for one in PANELS[name].curves for p in one.points]
    wanted = {p.label for p in points if p.label and math.isfinite(p.x) and math.isfinite(p.y)}
    found = labels(drawn(name))
    assert sorted(found) == sorted(wanted)


def test_the_default_of_every_curve_is_marked_in_one_colour_and_named_once() -> None:
    figure = draw([PANELS["tracking"], PANELS["collision"]])
    for axis, count in zip(figure.axes, (5, 1), strict=True):
        marked = [line for line in axis.get_lines() if same_color(line.get_color(), DEFAULT_COLOR)]
        assert [np.size(line.get_xdata()) for line in marked] == [count]
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()].count("default") == 1


def test_a_share_has_no_negative_numbers_and_a_zero_of_its_own() -> None:
    axis = drawn("collision").axes[0]
    assert axis.get_ylim()[0] == 0.0
    ticks = [tick for tick in axis.get_yticks() if tick <= axis.get_ylim()[1]]
    assert ticks[0] == 0.0
    assert min(ticks[1:]) <= 0.0045
    assert np.diff(axis.transData.transform([(1.0, tick) for tick in ticks])[:, 1]).min() > 30.0


def test_error_bars_reach_from_low_to_high() -> None:
    axis = drawn("planning").axes[0]
    bars = [segment for bar in axis.collections for segment in bar.get_segments()]  # type: ignore[attr-defined]
    assert len(bars) == 6
    for bar, point in zip(bars, PLANS[0].points, strict=True):
        np.testing.assert_allclose(bar, [(point.x, point.y - 0.03), (point.x, point.y + 0.03)])


def test_many_panels_make_rows_that_are_at_most_three_wide(tmp_path: Path) -> None:
    save_plot([PANELS["one point"]] * 4, tmp_path, "four")
    height, width, _ = cv2.imread(str(tmp_path / "four.png")).shape  # type: ignore[union-attr]
    assert width == 3 * 840
    assert height == 2 * 720
    assert b"<svg" in (tmp_path / "four.svg").read_bytes()


def test_the_page_behind_the_picture_does_not_show_through(tmp_path: Path) -> None:
    save_plot([PANELS["planning"]], tmp_path, "plan")
    image = cv2.imread(str(tmp_path / "plan.png"), cv2.IMREAD_UNCHANGED)
    assert image is not None
    assert (image[0, 0] == 255).all()
    assert image.shape[2] == 3 or image[..., 3].min() == 255


def test_equal_results_give_equal_files_and_settings_of_matplotlib_stay(tmp_path: Path) -> None:
    before = dict(matplotlib.rcParams)
    for name in ("a", "b"):
        save_plot([PANELS["planning"]], tmp_path, name)
    assert (tmp_path / "a.png").read_bytes() == (tmp_path / "b.png").read_bytes()
    assert (tmp_path / "a.svg").read_bytes() == (tmp_path / "b.svg").read_bytes()
    assert dict(matplotlib.rcParams) == before


def test_without_a_point_no_file_is_written(tmp_path: Path) -> None:
    save_plot([Panel("t", "x", "y", [curve("a", [(1.0, math.nan, "lost")])])], tmp_path, "none")
    save_plot([], tmp_path, "none")
    assert not list(tmp_path.iterdir())

"""The curves of README.md: their points, intervals and defaults, from the rows of the benchmarks."""

from __future__ import annotations

import inspect
from collections.abc import Sequence
from pathlib import Path

import pytest

from splatbot.bench.collision import plots as collision
from splatbot.bench.planning import plots as planning
from splatbot.bench.plots import Panel, Point
from splatbot.bench.results import Results, Row
from splatbot.bench.tracking import plots as tracking
from splatbot.config import Config
from splatbot.planning import GaussianRRTStar


@pytest.fixture
def drawn(monkeypatch: pytest.MonkeyPatch) -> dict[str, Sequence[Panel]]:
    """Return the panels that are drawn instead of their files, by name."""
    panels: dict[str, Sequence[Panel]] = {}
    for module in (collision, planning, tracking):
        monkeypatch.setattr(module, "save_plot", lambda found, folder, name: panels.update({name: found}))
    return panels


def test_an_edge_without_a_missed_collision_has_the_upper_bound_of_wilson(
    drawn: dict[str, Sequence[Panel]], tmp_path: Path
) -> None:
    rows = []
    for setting, us, missed in (("certified, 1 mm (default)", 9.0, 0.0), ("4 samples", 1.4, 329.0)):
        case = f"sweep edges on 200000 Gaussians: {setting}"
        rows += [Row(case, "an edge", us, "us"), Row(case, "false free, count", missed, "of 110000")]
    collision.plot_accuracy(Results({}, rows), tmp_path)
    (panel,) = drawn["collision-accuracy"]
    certified, sampled = (curve.points for curve in panel.curves)
    z2, n = 1.959963984540054**2, 110_000
    assert (certified[0].x, certified[0].y, certified[0].label, certified[0].default) == (9.0, 0.0, "1 mm", True)
    assert certified[0].low == pytest.approx(0.0, abs=1e-12)
    assert certified[0].high == pytest.approx(100.0 * z2 / (n + z2), rel=1e-9)  # the closed form for no event
    assert sampled[0].label == "4"
    assert sampled[0].y == pytest.approx(100.0 * 329 / n)
    assert sampled[0].low is not None
    assert sampled[0].high is not None
    assert sampled[0].low < sampled[0].y < sampled[0].high


def test_errors_over_n_sigma_are_those_of_the_map_with_most_values(
    drawn: dict[str, Sequence[Panel]], tmp_path: Path
) -> None:
    rows = []
    for gaussians, sigmas in ((10_000, ("2 (default)",)), (200_000, ("1", "2 (default)", "3"))):
        for sigma in sigmas:
            case = f"sweep n_sigma on {gaussians} Gaussians: {sigma}"
            rows += [Row(case, "false hit", 0.1, "%"), Row(case, "false free, count", 0.0, "of 1000")]
    collision.plot_sigma(Results({}, rows), tmp_path)
    (panel,) = drawn["collision-sigma"]
    assert panel.title.endswith("200000 Gaussians")
    for curve in panel.curves:
        assert [(p.x, p.default) for p in curve.points] == [(1.0, False), (2.0, True), (3.0, False)]


def test_budgets_of_planning_have_the_deviation_of_seeds_and_the_share_of_solved_problems(
    drawn: dict[str, Sequence[Panel]], tmp_path: Path
) -> None:
    rows = [
        Row("budget 1 ms", "solved", 45.0, "of 50"),
        Row("budget 1 ms", "cost, mean", 5.5, "rad", spread=0.02),
        Row("budget 28 ms", "solved", 50.0, "of 50"),
        Row("budget 28 ms", "cost, mean", 5.3, "rad"),
        Row("budget 28 ms", "cost, mean", 7.0, "rad", peer="OMPL"),
    ]
    planning.plot_cost(Results({}, rows), tmp_path)
    (panel,) = drawn["planning-cost"]
    ours, peer = panel.curves
    assert list(ours.points) == [
        Point(1.0, 5.5, "1 ms, 90 % solved", False, 5.5 - 0.02, 5.5 + 0.02),
        Point(28.0, 5.3, "28 ms", True),
    ]
    assert (peer.name, list(peer.points)) == ("OMPL", [Point(28.0, 7.0)])


def test_the_marked_budgets_are_the_defaults_of_the_code(drawn: dict[str, Sequence[Panel]], tmp_path: Path) -> None:
    assert inspect.signature(GaussianRRTStar.plan).parameters["budget_ms"].default == planning.DEFAULT_MS
    budgets = (30.0, Config().tracking.budget_ms, 1000.0)
    rows = []
    for budget in budgets:
        rows += [Row(f"desk, {budget:g} ms", "ATE", 1.0, "mm"), Row(f"desk, {budget:g} ms", "p50", 20.0, "ms")]
    tracking.plot_tracking(Results({}, rows), tmp_path)
    ((curve,),) = (panel.curves for panel in drawn["tracking"])
    assert [p.default for p in curve.points] == [False, True, False]


def test_logs_share_a_panel_and_with_other_trackers_each_has_its_own(
    drawn: dict[str, Sequence[Panel]], tmp_path: Path
) -> None:
    rows = [
        Row(f"{log}, {setting}", metric, 2.0, unit)
        for log in ("desk", "shelf")
        for setting in ("30 ms", "30 ms without bundle adjustment")
        for metric, unit in (("ATE", "mm"), ("p50", "ms"))
    ]
    tracking.plot_tracking(Results({}, rows), tmp_path)
    (panel,) = drawn["tracking"]
    change = " without bundle adjustment"
    assert [curve.name for curve in panel.curves] == ["desk", f"desk{change}", "shelf", f"shelf{change}"]
    rows += [Row("desk, ", metric, 9.0, unit, peer="OpenCV") for metric, unit in (("ATE", "mm"), ("p50", "ms"))]
    tracking.plot_tracking(Results({}, rows), tmp_path)
    desk, shelf = drawn["tracking"]
    assert [curve.name for curve in desk.curves] == ["splatbot", "without bundle adjustment", "OpenCV"]
    assert shelf.title == "shelf"

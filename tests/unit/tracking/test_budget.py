"""The anytime contract: a stage that does not fit is not started, and skipped stages are reported."""

from __future__ import annotations

import time
from dataclasses import replace

import numpy as np
import pytest

from splatbot.config import Config, TrackingConfig, load_config
from splatbot.logs import open_log
from splatbot.mapping.mapper import Mapper
from splatbot.slam import Slam
from splatbot.tracking.budget import CONSTANTS as COSTS
from splatbot.tracking.budget import Budget, CostModel, table_ms
from tests.unit.tracking.test_tracker import Run


@pytest.fixture
def stopped_clock(monkeypatch: pytest.MonkeyPatch) -> None:
    """No time passes between two lines of a test, however busy the machine is."""
    now = time.perf_counter()
    monkeypatch.setattr(time, "perf_counter", lambda: now)


def test_a_budget_buys_pixels_steps_and_keypoints_by_one_table() -> None:
    rows = [TrackingConfig(budget_ms=ms) for ms in (30, 99, 100, 300, 1000, 5000)]
    assert [row.n_pixels for row in rows] == sorted(row.n_pixels for row in rows)
    assert rows[0].n_pixels == rows[1].n_pixels < rows[2].n_pixels == 4800
    assert [row.iterations for row in rows] == sorted(row.iterations for row in rows)
    assert [row.n_features for row in rows] == sorted(row.n_features for row in rows)


def test_given_efforts_override_those_of_the_budget_and_null_restores_them() -> None:
    given = load_config(environ={}, overrides={"tracking.budget_ms": 30, "expert.tracking.n_pixels": 777})
    assert (given.tracking.n_pixels, given.tracking.n_features) == (777, TrackingConfig(budget_ms=30).n_features)
    left = load_config(environ={}, overrides={"tracking.budget_ms": 300, "expert.tracking.n_pixels": None})
    assert left.tracking.n_pixels == TrackingConfig(budget_ms=300).n_pixels


def test_the_expected_cost_of_a_stage_is_the_95th_percentile_of_recent_runs() -> None:
    costs = CostModel()
    for i in range(40):
        costs.record("direct", 1000.0, 2.0 * table_ms("direct", 1000.0) if i % 10 == 0 else table_ms("direct", 1000.0))
    assert costs.expected_ms("direct", 1000.0) == pytest.approx(2.0 * table_ms("direct", 1000.0))
    assert costs.expected_ms("direct", 5000.0) == pytest.approx(2.0 * table_ms("direct", 5000.0))
    for _ in range(40):
        costs.record("direct", 1000.0, table_ms("direct", 1000.0))
    assert costs.expected_ms("direct", 1000.0) == pytest.approx(table_ms("direct", 1000.0))


def test_one_slow_run_excludes_no_stage_and_two_do_until_they_are_forgotten() -> None:
    costs = CostModel()
    slow, usual = 20.0 * table_ms("detect", 500), table_ms("detect", 500)
    costs.begin_frame()
    costs.record("detect", 500, slow)  # by cold caches or another program
    assert costs.expected_ms("detect", 500) <= 1.5 * usual
    costs.record("detect", 500, usual)
    assert costs.expected_ms("detect", 500) == pytest.approx(usual)
    costs.record("detect", 500, slow)
    assert costs.expected_ms("detect", 500) == pytest.approx(slow)
    for _ in range(59):
        costs.begin_frame()
    assert costs.expected_ms("detect", 500) == pytest.approx(slow)
    costs.begin_frame()
    assert costs.expected_ms("detect", 500) == pytest.approx(1.5 * usual)


@pytest.mark.usefixtures("stopped_clock")
def test_stages_that_were_slow_at_times_are_started_while_lost() -> None:
    costs = CostModel()
    for slowness in (1.0, 8.0, 1.0, 8.0, 1.0):
        costs.record("detect", 500, slowness * table_ms("detect", 500))
    quantiles = COSTS.deadline_quantile, COSTS.lost_quantile
    tracked, lost = (Budget(30.0, costs, time.perf_counter(), quantile) for quantile in quantiles)
    assert not tracked.fits(("detect", 500))
    assert lost.fits(("detect", 500))
    assert not lost.fits(("detect", 500), ("detect", 8000))


def test_time_that_has_passed_is_not_left() -> None:
    budget = Budget(50.0, CostModel(), time.perf_counter() - 0.045)
    assert budget.left_ms <= 5.0
    assert not budget.fits(("detect", 2000))
    counted = Budget(50.0, None, time.perf_counter() - 10.0)
    assert counted.left_ms == 50.0 - table_ms("overhead", 1)
    with counted.run("detect", 1000):
        pass
    assert counted.left_ms == pytest.approx(50.0 - table_ms("overhead", 1) - table_ms("detect", 1000))


@pytest.mark.usefixtures("stopped_clock")
def test_the_overhead_of_most_frames_outside_the_stages_is_reserved() -> None:
    costs = CostModel()
    for ms in (7.0, 3.0, 7.0, 7.0, 60.0):  # the last frame becomes a keyframe
        costs.record("overhead", 1, ms)
    assert Budget(30.0, costs, time.perf_counter()).left_ms == pytest.approx(23.0, abs=0.5)


def test_the_slam_reports_its_own_overhead_to_the_tracker(monkeypatch: pytest.MonkeyPatch) -> None:
    slow = 0.03

    class SlowMapper(Mapper):
        @property
        def size(self) -> int:
            time.sleep(slow)
            return super().size

    monkeypatch.setattr("splatbot.slam.Mapper", SlowMapper)
    config = Config()
    config.tracking.deterministic = False
    slam = Slam(config)
    for frame in open_log("synthetic:tabletop?frames=4&width=160&height=120"):
        slam.process(frame)
    assert slam._tracker._costs.expected_ms("overhead", 1, COSTS.lost_quantile) > 1e3 * slow  # type: ignore[union-attr]


def test_without_time_for_features_the_frame_is_tracked_and_reports_them_as_skipped() -> None:
    """By the table, 5 ms suffice for alignment but not for the detection of keypoints."""
    run = Run(tracking__budget_ms=5)
    estimate = run.track(run.frames[1])
    assert estimate.verdict == "ok"
    assert "features" in estimate.skipped
    assert "features" not in estimate.stage_ms
    assert estimate.features is None
    assert run.error(estimate, 1)[0] < 1.5e-3


def test_with_little_time_there_are_fewer_keypoints() -> None:
    plenty, little = Run(width=320), Run(width=320, tracking__budget_ms=9)
    many, few = plenty.track(plenty.frames[1]).features, little.track(little.frames[1]).features
    assert many is not None
    assert few is not None
    assert len(few) < 0.7 * len(many)


def test_slow_stages_are_skipped_once_their_runs_are_recorded(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(time, "perf_counter", time.thread_time)  # other programs take no part in it
    run = Run(tracking__deterministic=False, tracking__budget_ms=1000)
    assert "features" in run.track(run.frames[1]).stage_ms
    costs = run.tracker._costs
    assert costs is not None
    for _ in range(40):
        costs.record("detect", 600, 5000.0)
    estimate = run.track(run.frames[2])
    assert "features" in estimate.skipped
    assert estimate.verdict == "ok"


def test_counted_work_gives_the_same_bits_however_slow_the_machine(monkeypatch: pytest.MonkeyPatch) -> None:
    fast, slow = Run(tracking__budget_ms=12), Run(tracking__budget_ms=12)
    poses = [fast.track(fast.frames[i]).T_world_camera for i in range(1, 6)]
    clock = time.perf_counter
    monkeypatch.setattr(time, "perf_counter", lambda: 1000 * clock())
    again = [slow.track(slow.frames[i]).T_world_camera for i in range(1, 6)]
    assert np.array_equal(poses, again)


def test_a_lost_camera_relocalizes_within_a_small_budget_by_one_keyframe_after_the_other() -> None:
    """One keyframe at a time fits, and the keyframe that shows the frame is not the latest."""
    run = Run(width=320, tracking__budget_ms=14, tracking__n_features=400)
    for i in (2, 4, 6, 8, 10, 11):
        run.keyframes.append(run.keyframe(run.prepare(run.frames[i]), run.poses[i]))
    dark = replace(run.frames[1], rgb=np.zeros_like(run.frames[1].rgb), depth=np.zeros_like(run.frames[1].depth))
    assert run.track(dark).verdict == "lost"
    verdicts = []
    for step in range(8):
        estimate = run.track(replace(run.frames[1], stamp=1.0 + step / 30))
        verdicts.append(estimate.verdict)
        if estimate.verdict == "ok":
            break
    assert verdicts[-1] == "ok", verdicts
    assert run.error(estimate, 1)[0] < 2e-3

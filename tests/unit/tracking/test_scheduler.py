"""The scheduler of the tracking stages: its decisions on frames whose first stages find a wrong pose."""

from __future__ import annotations

import ast
import inspect
import textwrap
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from splatbot.geometry import inverse, se3_exp, transform_points
from splatbot.slam import FrameResult, Slam
from splatbot.tracking import stage, stages
from splatbot.tracking.budget import Budget
from splatbot.tracking.features import FeaturePose, match_pose
from splatbot.tracking.hypothesis import Hypothesis
from splatbot.tracking.stage import StageCost, TrackingProblem, TrackingStage
from splatbot.tracking.stages import features as feature_stages
from splatbot.tracking.stages.geometric import GeometricStage
from splatbot.tracking.tracker import Tracker, pose_distance
from tests.rgbd import Array, small_config, tabletop
from tests.unit.tracking.test_tracker import Run

NEXT = 4
TRUE = tabletop()[1][NEXT]


@dataclass
class WrongStart:
    """A run on whose next frame the first stage and local matching find a wrong pose.

    Args:
        slam: the run.
        matched: scope of each matching ("near" or "anywhere") and its number of keyframes.
    """

    slam: Slam
    matched: list[tuple[str, int]] = field(default_factory=list)

    def result(self) -> FrameResult:
        """Process the next frame."""
        return self.slam.process(tabletop()[0][NEXT])


@pytest.fixture
def wrong_start(monkeypatch: pytest.MonkeyPatch) -> WrongStart:
    slam = Slam(small_config(mapping__keyframe_translation=1e-3))  # several keyframes
    for frame in tabletop()[0][:NEXT]:
        slam.process(frame)
    assert len(slam.keyframes) > 2
    wrong = TRUE @ se3_exp(np.array([0.12, -0.05, 0.03, 0.05, 0.12, -0.05]))
    run = WrongStart(slam)

    def matched(current: Any, keyframes: Any, camera: Any, expected: Any = None) -> FeaturePose | None:
        found = match_pose(current, keyframes, camera)
        run.matched.append(("anywhere" if expected is None else "near", len(keyframes)))
        if expected is None or found is None:
            return found
        pixels = camera.project(transform_points(inverse(wrong), found.points))
        return FeaturePose(wrong, found.points, pixels, 0.01 * found.sigmas, found.matches)

    monkeypatch.setattr(feature_stages, "match_pose", matched)
    start_at(wrong, monkeypatch)
    return run


def start_at(T_world_camera: Array, monkeypatch: pytest.MonkeyPatch) -> None:
    """Replace the pose of the geometric stage by a wrong one."""
    run = GeometricStage.run

    def moved(self: GeometricStage, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> Hypothesis:
        problem.start = run(self, problem, hypothesis, effort)
        return problem.hypothesis("geometric", T_world_camera)

    monkeypatch.setattr(GeometricStage, "run", moved)


def leave_time_for(share: float, monkeypatch: pytest.MonkeyPatch, kind: str = "match all") -> None:
    """Let a share of the first request for a kind of work fit, and all other work."""
    requests: list[float] = []

    def fits(budget: Budget, *work: tuple[str, float]) -> bool:
        name, units = work[0]
        if not name.startswith(kind):
            return True
        requests.append(units)
        return units <= share * requests[0]

    monkeypatch.setattr(Budget, "fits", fits)


def test_a_wrong_pose_of_local_matching_is_replaced_by_that_of_all_features(wrong_start: WrongStart) -> None:
    result = wrong_start.result()
    assert [scope for scope, _ in wrong_start.matched] == ["near", "anywhere"]
    assert result.T_world_camera is not None
    assert result.verdict == "ok"
    assert pose_distance(TRUE, result.T_world_camera)[0] < 2e-3


def test_the_time_of_a_stage_is_charged_to_no_other_stage(
    wrong_start: WrongStart, monkeypatch: pytest.MonkeyPatch
) -> None:
    run, open_runs, kinds = Budget.run, list[str](), list[str]()

    @contextmanager
    def charge(budget: Budget, kind: str, units: float, under: str | None = None) -> Iterator[None]:
        assert open_runs == []
        open_runs.append(kind)
        with run(budget, kind, units, under):
            yield
        kinds.append(open_runs.pop())

    monkeypatch.setattr(Budget, "run", charge)
    wrong_start.result()
    assert kinds[-4:] == ["health", "match all", "direct", "health"]


def test_without_time_for_all_keyframes_features_are_matched_with_the_nearest(
    wrong_start: WrongStart, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_time_for(0.6, monkeypatch)
    result = wrong_start.result()
    (_, all_), (_, some) = wrong_start.matched
    assert 1 <= some < all_
    assert result.T_world_camera is not None
    assert result.skipped == ()
    assert pose_distance(TRUE, result.T_world_camera)[0] < 2e-3


def test_a_pose_that_explains_little_is_degraded_without_time_for_a_wider_search(
    wrong_start: WrongStart, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_time_for(0, monkeypatch)
    result = wrong_start.result()
    assert [scope for scope, _ in wrong_start.matched] == ["near"]
    assert result.skipped == ("features anywhere",)
    assert result.verdict != "ok"
    assert any("no time was left" in reason for reason in result.reasons)


def test_with_little_time_the_direct_stage_takes_fewer_steps_and_a_pose_without_it_is_degraded(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    start_at(TRUE @ se3_exp(np.array([0.015, -0.006, 0.004, 0.006, 0.015, -0.006])), monkeypatch)
    errors, skipped = [], []
    for share in 0.0, 0.5, 1.0:  # half of the time suffices for a quarter of the steps
        slam = Slam(small_config(tracking__features="needed", tracking__gicp="never"))
        with monkeypatch.context() as patched:
            leave_time_for(share, patched, kind="direct")
            slam.process(tabletop()[0][0])
            result = slam.process(tabletop()[0][NEXT])
        assert result.T_world_camera is not None
        assert any("no time was left" in reason for reason in result.reasons) == (share == 0)
        errors.append(pose_distance(TRUE, result.T_world_camera)[0])
        skipped.append(result.skipped)
    none, some, all_ = errors
    assert skipped == [("direct",), ("direct steps",), ()]
    assert all_ < 2e-3
    assert some < 0.5 * none


def test_the_cost_of_few_steps_does_not_change_the_expected_cost_of_all(monkeypatch: pytest.MonkeyPatch) -> None:
    slam = Slam(small_config(tracking__deterministic=False))
    for frame in tabletop()[0][:3]:
        slam.process(frame)
    costs = slam._tracker._costs
    assert costs is not None
    before = costs.expected_ms("direct", 1e6)
    leave_time_for(0.5, monkeypatch, kind="direct")
    for frame in tabletop()[0][3:5]:
        assert "direct steps" in slam.process(frame).skipped
    assert costs.expected_ms("direct", 1e6) == before


class OracleStage(TrackingStage):
    """A new stage: it proposes the true pose, and costs as much as a test sets."""

    name = skipped_name = "oracle"
    units = 3.0
    runs = 0

    def cost(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> StageCost:
        """Return the work that a test sets."""
        return StageCost(("oracle", self.units))

    def run(self, problem: TrackingProblem, hypothesis: Hypothesis, effort: int) -> Hypothesis:
        """Propose the true pose."""
        type(self).runs += 1
        return problem.hypothesis(self.name, TRUE)


@pytest.mark.parametrize(("units", "chosen"), [(3.0, True), (1e6, False)])
def test_a_new_stage_in_the_list_is_scheduled_charged_and_scored(
    units: float, chosen: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(stages, "PROPOSAL_STAGES", (OracleStage,))  # other stages would rescue the frame
    monkeypatch.setattr(OracleStage, "units", units)
    monkeypatch.setattr(OracleStage, "runs", 0)
    start_at(TRUE @ se3_exp(np.array([0.3, 0.0, 0.0, 0.0, 0.3, 0.0])), monkeypatch)
    charged: list[tuple[str, float]] = []
    run = Budget.run

    def charge(budget: Budget, kind: str, units: float, under: str | None = None) -> Any:
        charged.append((kind, units))
        return run(budget, kind, units, under)

    monkeypatch.setattr(Budget, "run", charge)
    tracking = Run(tracking__features="needed", tracking__gicp="never", tracking__features_motion=10.0)
    estimate = tracking.track(tracking.frames[NEXT])
    assert OracleStage.runs == int(chosen)
    assert (("oracle", units) in charged) == ("oracle" in estimate.stage_ms) == chosen
    assert ("oracle" in estimate.skipped) != chosen
    assert (estimate.stage == "oracle+direct") == chosen
    assert (tracking.error(estimate, NEXT)[0] < 2e-3) == chosen


def imported_modules(path: Path) -> Iterator[str]:
    """Yield the modules that a file imports, and the names that it imports from them."""
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom) and node.module is not None:
            yield node.module
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_no_stage_imports_the_budget() -> None:
    files = [Path(str(stage.__file__)), *Path(stages.__path__[0]).glob("*.py")]
    assert len(files) > 6
    forbidden = {"splatbot.tracking.budget", "splatbot.tracking.scheduler"}
    assert [file.name for file in files if forbidden & set(imported_modules(file))] == []


def test_track_reads_like_an_algorithm_box() -> None:
    (function,) = ast.parse(textwrap.dedent(inspect.getsource(Tracker.track))).body
    statements = [node for node in ast.walk(function) if isinstance(node, ast.stmt)]
    assert len(statements) - 2 <= 12  # without the function itself and its docstring


def test_at_most_six_functions_lie_between_the_slam_and_opencv(monkeypatch: pytest.MonkeyPatch) -> None:
    depths: list[int] = []

    def counted(function: Any) -> Any:
        def call(*args: Any, **kwargs: Any) -> Any:
            functions = [frame.function for frame in inspect.stack(context=0)[1:]]
            depths.append(functions.index("process"))
            return function(*args, **kwargs)

        return call

    monkeypatch.setattr(cv2, "solvePnPRansac", counted(cv2.solvePnPRansac))
    monkeypatch.setattr(cv2, "cvtColor", counted(cv2.cvtColor))
    slam = Slam(small_config())
    for frame in tabletop()[0][:3]:
        slam.process(frame)
    assert len(depths) > 3
    assert max(depths) <= 6

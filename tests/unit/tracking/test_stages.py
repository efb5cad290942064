"""What the stages make of a frame where the first of them are led astray."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any

import numpy as np
import pytest

from splatbot.geometry import inverse, se3_exp, transform_points
from splatbot.slam import FrameResult, Slam
from splatbot.tracking import stages
from splatbot.tracking.budget import Budget
from splatbot.tracking.features import FeaturePose, match_pose
from splatbot.tracking.tracker import pose_distance
from tests.rgbd import small_config, tabletop


@dataclass
class Astray:
    """A run whose next frame is led to a wrong pose, by the first stage and by the features near to it."""

    slam: Slam
    views: list[tuple[str, int]] = field(default_factory=list)
    """Where features were looked for, and in how many keyframes."""

    def result(self) -> FrameResult:
        return self.slam.process(tabletop()[0][NEXT])


NEXT = 4
TRUE = tabletop()[1][NEXT]


@pytest.fixture
def astray(monkeypatch: pytest.MonkeyPatch) -> Astray:
    slam = Slam(small_config(mapping__keyframe_translation=1e-3))  # several keyframes
    for frame in tabletop()[0][:NEXT]:
        slam.process(frame)
    assert len(slam.keyframes) > 2
    wrong = TRUE @ se3_exp(np.array([0.12, -0.05, 0.03, 0.05, 0.12, -0.05]))
    run = Astray(slam)

    def matched(current: Any, keyframes: Any, camera: Any, expected: Any = None) -> FeaturePose | None:
        found = match_pose(current, keyframes, camera)
        run.views.append(("anywhere" if expected is None else "near", len(keyframes)))
        if expected is None or found is None:
            return found
        pixels = camera.project(transform_points(inverse(wrong), found.points))
        return FeaturePose(wrong, found.points, pixels, 0.01 * found.sigmas, found.matches)

    monkeypatch.setattr(stages, "match_pose", matched)
    monkeypatch.setattr(stages.TrackingStages, "_geometric", started_at(wrong, stages.TrackingStages._geometric))
    return run


def leave_time_for(share: float, monkeypatch: pytest.MonkeyPatch, of: str = "match all") -> None:
    """For a share of the work that a stage asks for first (all of it); for all other stages there is time."""
    asked: list[float] = []

    def fits(budget: Budget, *work: tuple[str, float]) -> bool:
        stage, units = work[0]
        if not stage.startswith(of):
            return True
        asked.append(units)
        return units <= share * asked[0]

    monkeypatch.setattr(Budget, "fits", fits)


def test_a_wrong_pose_that_nearby_features_agree_on_is_replaced_by_what_all_features_say(astray: Astray) -> None:
    result = astray.result()
    assert [where for where, _ in astray.views] == ["near", "anywhere"]
    assert result.T_world_camera is not None
    assert result.verdict == "ok"
    assert pose_distance(TRUE, result.T_world_camera)[0] < 2e-3


def test_without_time_for_all_keyframes_features_are_looked_for_in_the_nearest(
    astray: Astray, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_time_for(0.6, monkeypatch)
    result = astray.result()
    (_, all_), (_, some) = astray.views
    assert 1 <= some < all_
    assert result.T_world_camera is not None
    assert result.skipped == ()
    assert pose_distance(TRUE, result.T_world_camera)[0] < 2e-3


def test_a_pose_that_explains_little_is_doubted_when_there_is_no_time_to_look_further(
    astray: Astray, monkeypatch: pytest.MonkeyPatch
) -> None:
    leave_time_for(0, monkeypatch)
    result = astray.result()
    assert [where for where, _ in astray.views] == ["near"]
    assert result.skipped == ("features anywhere",)
    assert result.verdict != "ok"
    assert any("no time was left" in reason for reason in result.reasons)


def test_with_little_time_the_direct_stage_takes_fewer_steps_and_a_pose_with_none_is_doubted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    apart = np.array([0.015, -0.006, 0.004, 0.006, 0.015, -0.006])  # from where the coarse levels led to
    monkeypatch.setattr(
        stages.TrackingStages, "_geometric", started_at(TRUE @ se3_exp(apart), stages.TrackingStages._geometric)
    )
    errors, skipped = [], []
    for share in 0.0, 0.5, 1.0:  # half of the time is enough for a quarter of the steps
        slam = Slam(small_config(tracking__features="needed", tracking__gicp="never"))
        with monkeypatch.context() as patched:
            leave_time_for(share, patched, of="direct")
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


def test_what_few_steps_cost_does_not_speak_against_all_of_them(monkeypatch: pytest.MonkeyPatch) -> None:
    slam = Slam(small_config(tracking__deterministic=False))
    for frame in tabletop()[0][:3]:
        slam.process(frame)
    costs = slam._tracker._costs
    assert costs is not None
    before = costs.expected_ms("direct", 1e6)
    leave_time_for(0.5, monkeypatch, of="direct")
    for frame in tabletop()[0][3:5]:
        assert "direct steps" in slam.process(frame).skipped
    assert costs.expected_ms("direct", 1e6) == before


def started_at(T_world_camera: Any, geometric: Any) -> Any:
    """The geometric stage, led to a wrong pose."""

    def stage(self: Any, prediction: Any) -> Any:
        return self._start("geometric", T_world_camera, geometric(self, prediction))

    return stage

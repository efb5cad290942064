"""What the stages make of a frame where the first of them are led astray."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from splatbot.geometry import inverse, se3_exp, transform_points
from splatbot.slam import Slam
from splatbot.tracking import attempt
from splatbot.tracking.features import FeaturePose, match_pose
from splatbot.tracking.tracker import pose_distance
from tests.rgbd import small_config, tabletop


def test_a_wrong_pose_that_nearby_features_agree_on_is_replaced_by_what_all_features_say(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    frames, poses = tabletop()
    slam = Slam(small_config())
    for frame in frames[:4]:
        slam.process(frame)
    wrong = poses[4] @ se3_exp(np.array([0.12, -0.05, 0.03, 0.05, 0.12, -0.05]))
    looked = []

    def astray(current: Any, keyframes: Any, camera: Any, expected: Any = None) -> FeaturePose | None:
        found = match_pose(current, keyframes, camera)
        looked.append("anywhere" if expected is None else "near")
        if expected is None or found is None:
            return found
        pixels = camera.project(transform_points(inverse(wrong), found.points))
        return FeaturePose(wrong, found.points, pixels, 0.01 * found.sigmas, found.matches)

    monkeypatch.setattr(attempt, "match_pose", astray)
    monkeypatch.setattr(attempt.Attempt, "_geometric", started_at(wrong, attempt.Attempt._geometric))
    result = slam.process(frames[4])
    assert looked == ["near", "anywhere"]
    assert result.T_world_camera is not None
    assert pose_distance(poses[4], result.T_world_camera)[0] < 2e-3


def started_at(T_world_camera: Any, geometric: Any) -> Any:
    """The geometric stage, led to a wrong pose."""

    def stage(self: Any, prediction: Any) -> Any:
        return self._start("geometric", T_world_camera, geometric(self, prediction))

    return stage

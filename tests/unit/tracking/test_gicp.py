"""G-ICP registration: its basin of convergence, and frames that it cannot register."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatbot.geometry import se3_exp
from splatbot.tracking.gicp import GicpRegistration, cloud_of, points_of
from splatbot.tracking.tracker import pose_distance
from tests.unit.tracking.test_tracker import Run


@pytest.mark.parametrize("twist", [[0.08, 0, 0, 0, 0.087, 0], [0.0, 0.1, 0.05, 0.1, 0, 0], [0.1, 0, 0, 0, 0, 0.15]])
def test_a_start_wrong_by_10_cm_and_8_degrees_converges_to_a_centimetre(twist: list[float]) -> None:
    run = Run(width=320)
    start = run.poses[2] @ se3_exp(twist)
    found = GicpRegistration().register(run.prepare(run.frames[2]), run.keyframes[0], start, 3000)
    assert found is not None
    moved, turned = pose_distance(run.poses[2], found)
    assert moved < 0.012
    assert turned < np.radians(0.7)


def test_a_frame_without_depth_has_no_pose_from_registration() -> None:
    run = Run()
    empty = run.prepare(replace(run.frames[1], depth=np.zeros_like(run.frames[1].depth)))
    assert GicpRegistration().register(empty, run.keyframes[0], np.eye(4), 4000) is None


def test_clouds_without_overlap_have_no_pose_from_registration() -> None:
    run = Run()
    away = se3_exp([30.0, 0, 0, 0, 0, 0])
    assert GicpRegistration().register(run.prepare(run.frames[1]), run.keyframes[0], away, 4000) is None


def test_points_are_about_as_many_as_requested_and_too_few_make_no_cloud() -> None:
    run = Run(width=320)
    assert 600 < len(points_of(run.prepare(run.frames[0]), 1000)) < 1700
    assert cloud_of(np.zeros((5, 3))) is None


def test_a_fast_motion_is_bridged_without_features_by_registration() -> None:
    """The camera jumps by 10 cm and 7°, and the features of the keyframe have no depth; alignment alone diverges."""
    run = Run(width=320)
    view = run.keyframes[0]
    run.keyframes = [replace(view, features=replace(view.features, points=np.full_like(view.features.points, np.nan)))]
    run.tracker.motion.update(run.frames[0].stamp, se3_exp([0.1, 0, 0, 0, 0.12, 0]))
    run.tracker.motion.forget_velocity()
    estimate = run.track(run.frames[1])
    assert "gicp" in estimate.stage_ms
    assert estimate.verdict == "ok", estimate.reasons
    assert run.error(estimate, 1)[0] < 2e-3

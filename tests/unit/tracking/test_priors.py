"""Robot priors: fused by their covariance, and rejected if they contradict the frame."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.frame import PosePrior
from splatbot.geometry import inverse, se3_exp
from splatbot.tracking.align import Alignment
from splatbot.tracking.health import Health
from splatbot.tracking.hypothesis import Hypothesis, ScoredHypothesis
from splatbot.tracking.motion_model import ConstantVelocity, Prediction
from splatbot.tracking.priors import fuse, is_consistent, mahalanobis_distance
from splatbot.tracking.tracker import PoseEstimate
from tests.rgbd import wall_frame
from tests.unit.tracking.test_tracker import Run

PRECISE = np.diag([1e-6] * 3 + [1e-6] * 3)  # 1 mm, 0.06°


def pose(twist: list[float]) -> ScoredHypothesis:
    found = Alignment(se3_exp(twist), np.eye(6), np.eye(6), np.eye(6), 48, 525.0)
    return ScoredHypothesis(Hypothesis("direct", found, []), Health(1, 1, 1, 1, 0.5, 1), "ok", (), None, np.eye(6))


def tracked_with_prior(run: Run, i: int, T_world_camera: NDArray[np.float64], *, absolute: bool) -> PoseEstimate:
    """Track frame i after frame 1 with a precise prior: its pose, or its motion since frame 1."""
    relative = inverse(run.poses[1]) @ T_world_camera
    prior = (
        PosePrior(PRECISE, T_world_camera=T_world_camera)
        if absolute
        else PosePrior(PRECISE, T_previous_camera=relative)
    )
    estimate = run.track(replace(run.frames[i], prior=prior))
    assert estimate.verdict == "ok", estimate.reasons
    return estimate


def test_fusion_is_the_information_weighted_mean_and_the_parallel_sum_of_covariances() -> None:
    C, P = np.diag([1.0, 4.0, 1.0, 1.0, 2.0, 1.0]) * 1e-6, np.diag([3.0, 1.0, 1.0, 1.0, 2.0, 9.0]) * 1e-6
    there = np.array([1e-3, 2e-3, 0, 0, 0, 0])
    T, covariance = fuse(pose([0.0] * 6), Prediction(se3_exp(there), P), C)
    np.testing.assert_allclose(covariance, np.linalg.inv(np.linalg.inv(C) + np.linalg.inv(P)), atol=1e-15)
    np.testing.assert_allclose(
        T[:3, 3], (np.linalg.inv(np.linalg.inv(C) + np.linalg.inv(P)) @ np.linalg.inv(P) @ there)[:3]
    )


def test_the_gate_is_the_distance_that_one_correct_prior_in_ten_thousand_exceeds() -> None:
    rng = np.random.default_rng(0)
    d2 = (rng.standard_normal((400_000, 6)) ** 2).sum(1)
    share = np.mean([not is_consistent(d) for d in np.sqrt(np.sort(d2)[-200:])]) * 200 / len(d2)
    assert share == pytest.approx(1e-4, rel=0.35)
    distance = mahalanobis_distance(pose([0.0] * 6), Prediction(se3_exp([0.01, 0, 0, 0, 0, 0]), PRECISE), PRECISE)
    assert distance == pytest.approx(0.01 / np.sqrt(2e-6))


def test_relative_motions_of_lost_frames_accumulate() -> None:
    motion, step = ConstantVelocity(), se3_exp([0.02, 0, 0.01, 0, 0.05, 0])
    motion.update(0.0, np.eye(4))
    prior = PosePrior(PRECISE, T_previous_camera=step)
    for _ in range(3):
        motion.forget_velocity(motion.robot_prior(prior, np.zeros((6, 6))))
    again = motion.robot_prior(prior, np.zeros((6, 6)))
    np.testing.assert_allclose(again.T_world_camera, step @ step @ step @ step, atol=1e-12)
    assert again.covariance[0, 0] > 3.9e-6


@pytest.mark.parametrize("absolute", [True, False])
def test_a_correct_prior_tracks_a_jump_outside_the_basin_of_features_and_alignment(absolute: bool) -> None:
    """The camera moves 10 cm in one frame at 30 Hz, without features."""
    run = Run(tracking__features="needed", tracking__features_motion=10.0, tracking__features_rotation=10.0)
    run.track(run.frames[1])
    estimate = tracked_with_prior(run, 9, run.poses[9], absolute=absolute)
    assert run.error(estimate, 9)[0] < 2e-3
    assert not estimate.reasons


@pytest.mark.parametrize("shift", [0.02, 0.3])
@pytest.mark.parametrize("absolute", [True, False])
def test_a_wrong_prior_is_rejected_and_reported(absolute: bool, shift: float) -> None:
    """The errors are 20 and 300 standard deviations of the prior."""
    run = Run()
    run.track(run.frames[1])
    wrong = run.poses[2] @ se3_exp([shift, -shift, 0.5 * shift, 0, 0, 0])
    estimate = tracked_with_prior(run, 2, wrong, absolute=absolute)
    assert run.error(estimate, 2)[0] < 1.5e-3
    assert any("the prior is" in reason and "left out" in reason for reason in estimate.reasons)


def test_on_a_blank_wall_the_prior_determines_the_directions_along_the_wall() -> None:
    run = Run(tracking__features="needed", tracking__features_motion=10.0, tracking__features_rotation=10.0)
    camera = run.frames[0].camera
    here, there = (wall_frame(T, textured=False, camera=camera) for T in (np.eye(4), se3_exp([0.05, 0, 0, 0, 0, 0])))
    run.keyframes = [run.keyframe(run.prepare(here), np.eye(4))]
    run.tracker.motion.update(0.0, np.eye(4))
    prior = PosePrior(np.diag([1e-4] * 3 + [1e-4] * 3), T_previous_camera=se3_exp([0.05, 0, 0, 0, 0, 0]))
    estimate = run.track(replace(there, stamp=1 / 30, prior=prior))
    assert estimate.verdict == "degraded"
    assert estimate.T_world_camera[0, 3] == pytest.approx(0.05, abs=2e-3)
    deviations = np.sqrt(np.diag(estimate.covariance))
    assert deviations[0] == pytest.approx(1e-2, rel=0.3)
    assert deviations[2] < 5e-3

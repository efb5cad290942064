"""The tracker: accuracy of poses, the best hypothesis, and lost frames that do not change its state."""

from __future__ import annotations

from dataclasses import dataclass, replace
from types import SimpleNamespace

import numpy as np
import pytest

from splatbot.config import TrackingConfig
from splatbot.frame import Frame
from splatbot.geometry import se3_exp
from splatbot.tracking.align import Alignment
from splatbot.tracking.degeneracy import weak_directions
from splatbot.tracking.features import Features
from splatbot.tracking.health import Health
from splatbot.tracking.hypothesis import Hypothesis, ScoredHypothesis
from splatbot.tracking.motion_filter import CameraMotion
from splatbot.tracking.motion_model import Prediction
from splatbot.tracking.prepare import PreparedFrame, prepare
from splatbot.tracking.reference import Reference, make_reference
from splatbot.tracking.tracker import PoseEstimate, Tracker, order_by_distance, pose_distance
from splatbot.tracking.uncertainty import alignment_covariance
from tests.rgbd import Array, small_config, tabletop, wall_frame


@dataclass(frozen=True)
class View:
    """A keyframe with the attributes that the tracker uses."""

    features: Features
    reference: Reference


class Run:
    """A tracker on the tabletop with the first frame as its keyframe."""

    def __init__(self, width: int = 160, **overrides: object) -> None:
        self.config: TrackingConfig = small_config(**overrides).tracking
        self.frames, self.poses = tabletop(width=width)
        self.tracker = Tracker(self.config)
        first = self.prepare(self.frames[0])
        assert self.tracker.start(first).verdict == "ok"
        self.keyframes = [self.keyframe(first, np.eye(4))]

    def prepare(self, frame: Frame) -> PreparedFrame:
        return prepare(frame, self.config)

    def keyframe(self, prepared: PreparedFrame, T: Array) -> View:
        reference = make_reference(prepared.levels, T, self.config.n_pixels)
        return View(self.tracker.keypoints(prepared, PoseEstimate(T, "ok", (), "start"))(), reference)

    def track(self, frame: Frame) -> PoseEstimate:
        return self.tracker.track(self.prepare(frame), self.keyframes)

    def error(self, estimate: PoseEstimate, index: int) -> tuple[float, float]:
        return pose_distance(self.poses[index], estimate.T_world_camera)


def black(frame: Frame, **changes: object) -> Frame:
    return replace(frame, rgb=np.zeros_like(frame.rgb), **changes)  # type: ignore[arg-type]


def test_frames_are_tracked_to_a_millimetre_and_a_tenth_of_a_degree() -> None:
    run = Run()
    for i in range(1, 8):
        estimate = run.track(run.frames[i])
        assert estimate.verdict == "ok", estimate.reasons
        moved, turned = run.error(estimate, i)
        assert moved < 1.5e-3
        assert turned < np.radians(0.1)


def test_every_stage_that_ran_is_timed() -> None:
    run = Run()
    estimate = run.track(run.frames[1])
    assert set(estimate.stage_ms) == {"geometric", "features", "direct", "health"}
    assert min(estimate.stage_ms.values()) >= 0.0
    assert estimate.features is not None
    assert estimate.health is not None


def test_the_first_frame_defines_the_world() -> None:
    run = Run()
    estimate = Tracker(run.config).start(run.prepare(run.frames[3]))
    assert (estimate.verdict, estimate.stage) == ("ok", "start")
    assert np.array_equal(estimate.T_world_camera, np.eye(4))


def test_a_first_frame_without_depth_or_without_an_image_is_refused_with_the_reason() -> None:
    run = Run()
    frame = run.frames[0]
    blind = Tracker(run.config).start(run.prepare(replace(frame, depth=np.zeros_like(frame.depth))))
    assert blind.verdict == "lost"
    assert "0.0% of the pixels have a usable depth" in blind.reasons[0]
    dark = Tracker(run.config).start(run.prepare(black(frame)))
    assert dark.verdict == "lost"
    assert "blank" in dark.reasons[0]


@pytest.mark.parametrize("has_depth", [False, True])
def test_black_frames_are_lost_with_the_reason_and_the_second_good_one_is_accepted(has_depth: bool) -> None:
    run = Run()
    for i in (1, 2):
        run.track(run.frames[i])
    for i in (3, 4):
        depth = run.frames[i].depth if has_depth else np.zeros_like(run.frames[i].depth)
        estimate = run.track(black(run.frames[i], depth=depth))
        assert estimate.verdict == "lost"
        assert any("blank" in reason for reason in estimate.reasons)
        assert np.isfinite(estimate.T_world_camera).all()
    candidate = run.track(run.frames[5])
    assert (candidate.verdict, candidate.reasons) == ("lost", ("found again, the next frame must confirm it",))
    found = run.track(run.frames[6])
    assert found.verdict == "ok"
    assert run.error(found, 6)[0] < 1.5e-3


def test_a_lost_frame_does_not_move_the_prediction() -> None:
    run = Run()
    run.track(run.frames[1])
    before = run.tracker.motion.T_world_camera
    run.track(black(run.frames[2]))
    assert np.array_equal(run.tracker.motion.predict(run.frames[3].stamp), before)


def test_features_find_a_camera_far_from_its_prediction_and_the_health_selects_them() -> None:
    """The prediction is wrong by 30 cm and 17°, from which alignment does not converge."""
    run = Run(width=320)
    run.tracker.motion.update(run.frames[4].stamp, run.poses[4] @ se3_exp([0.3, 0, 0, 0, 0.3, 0]))
    run.tracker.motion.forget_velocity()
    estimate = run.track(run.frames[5])
    assert estimate.verdict == "ok"
    assert estimate.stage == "features+direct"
    assert run.error(estimate, 5)[0] < 2e-3


def test_a_jump_to_a_place_never_seen_is_lost() -> None:
    run = Run()
    unknown = wall_frame(np.eye(4), distance=2.5, camera=run.frames[0].camera, stamp=0.1)
    estimate = run.track(unknown)
    assert estimate.verdict == "lost"
    assert estimate.reasons


def test_features_are_matched_only_when_needed_if_so_configured() -> None:
    run = Run(tracking__features="needed")
    calm = run.track(run.frames[1])
    assert "features" not in calm.stage_ms
    assert calm.features is None
    assert run.error(calm, 1)[0] < 1.5e-3
    run.track(black(run.frames[2]))
    assert "features" in run.track(run.frames[3]).stage_ms  # after a lost frame
    run.tracker.motion.update(run.frames[4].stamp, run.poses[4])
    run.tracker.motion.update(run.frames[5].stamp, run.poses[5] @ se3_exp([0.1, 0, 0, 0, 0, 0]))
    assert "features" in run.track(run.frames[6]).stage_ms  # a fast motion is predicted


def test_the_same_frames_give_the_same_poses_bit_for_bit() -> None:
    first, second = Run(), Run()
    for i in (1, 2, 3):
        one, two = first.track(first.frames[i]), second.track(second.frames[i])
        assert np.array_equal(one.T_world_camera, two.T_world_camera)
        assert one.health == two.health


def test_distance_between_poses_is_the_distance_between_origins_and_the_angle_between_axes() -> None:
    T = se3_exp([0.3, -1.0, 2.0, 0.5, 1.0, -0.2])
    moved = np.eye(4)
    moved[:3, 3] = [0.0, 3.0, 4.0]
    turned = se3_exp([0, 0, 0, 0, 0.7, 0])
    assert pose_distance(T, T @ moved @ turned) == pytest.approx((5.0, 0.7))
    assert pose_distance(T, T) == pytest.approx((0.0, 0.0), abs=1e-12)


def test_keyframes_are_ordered_by_distance_a_radian_counting_half_a_metre() -> None:
    run = Run()
    features = run.keyframes[0].features

    def at(*twist: float) -> View:
        return View(features, Reference(se3_exp(twist), ()))

    views = [at(0.3, 0, 0, 0, 0, 0), at(0, 0, 0, 0, 0.5, 0), at(0.1, 0, 0, 0, 0, 0), at(0.1, 0, 0, 0, 0.5, 0)]
    assert order_by_distance(views, np.eye(4)) == [2, 1, 0, 3]


def test_an_unconstrained_direction_is_as_uncertain_as_it_errs() -> None:
    """A corridor along x for 2 s, where accelerations of 1 m/s² persist for 0.1 s: the stated σ is the RMS error."""
    information = np.diag([0.0, 1e7, 1e7, 1e7, 1e7, 1e7])
    weak = weak_directions(information, 1.0, TrackingConfig().min_eigen_ratio)
    errors, sigmas = [], []
    for seed in range(20):
        rng, tracker, x, v, a = np.random.default_rng(seed), Tracker(TrackingConfig()), 0.0, 0.3, 0.0
        tracker._filter.update(CameraMotion.at_pose(0.0, np.eye(4), np.zeros((6, 6)), np.array([v, 0, 0, 0, 0, 0])))
        tracker.motion.update(-1 / 30, se3_exp([-v / 30, 0, 0, 0, 0, 0]))
        tracker.motion.update(0.0, np.eye(4))
        for k in range(60):
            a = rng.normal() if k % 3 == 0 else a
            x, v, stamp = x + v / 30 + a / 1800, v + a / 30, (k + 1) / 30
            prior = tracker.motion.motion_prior(stamp, tracker._last_covariance)
            alignment = Alignment(prior.T_world_camera, information, information, information, 48, 500.0)
            health = Health(1.0, 1.0, 1.0, 1.0, 1.0, 1.0)
            best = ScoredHypothesis(
                Hypothesis("direct", alignment, []), health, "degraded", (), weak, alignment_covariance(alignment)
            )
            prepared = SimpleNamespace(frame=SimpleNamespace(stamp=stamp), twist=np.zeros(6))
            filled = tracker._fuse_prior(best, None, prior)
            pose, _ = tracker._filter_motion(*filled, best, prepared, None)  # type: ignore[arg-type]
            tracker._update(stamp, pose, None)
        errors.append(pose.T_world_camera[0, 3] - x)
        sigmas.append(pose.covariance[0, 0] ** 0.5)
    ratio = np.sqrt(np.mean(np.square(errors))) / np.mean(sigmas)
    assert 0.5 < ratio < 1.5


@pytest.mark.parametrize("gap", [0.1, 0.2])
def test_an_unconstrained_direction_stays_that_of_the_prediction_after_a_gap(gap: float) -> None:
    """Over 0.2 s the velocity is unknown. The alignment is half a metre off along a corridor, which it cannot see."""
    information = np.diag([0.0, 1e7, 1e7, 1e7, 1e7, 1e7])
    weak = weak_directions(information, 1.0, TrackingConfig().min_eigen_ratio)
    tracker = Tracker(TrackingConfig())
    tracker._filter.update(CameraMotion.at_pose(0.0, np.eye(4), 1e-6 * np.eye(6), np.zeros(6)))
    alignment = Alignment(se3_exp([0.5, 0, 0, 0, 0, 0]), information, information, information, 48, 500.0)
    health, hypothesis = Health(1.0, 1.0, 1.0, 1.0, 1.0, 1.0), Hypothesis("direct", alignment, [])
    best = ScoredHypothesis(hypothesis, health, "degraded", (), weak, alignment_covariance(alignment))
    filled = tracker._fuse_prior(best, None, Prediction(np.eye(4), 1e-4 * np.eye(6)))
    prepared = SimpleNamespace(frame=SimpleNamespace(stamp=gap), twist=np.zeros(6))
    pose, _ = tracker._filter_motion(*filled, best, prepared, None)  # type: ignore[arg-type]
    assert abs(pose.T_world_camera[0, 3]) < 1e-3

"""Camera tracking against the keyframes of the map."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from splatbot.config import TrackingConfig
from splatbot.frame import Frame
from splatbot.geometry import se3_exp
from splatbot.tracking.budget import CostModel
from splatbot.tracking.estimate import PoseEstimate
from splatbot.tracking.features import Features, detect
from splatbot.tracking.gyroscope import Gyroscope, MeasuredTurn
from splatbot.tracking.hypothesis import ScoredHypothesis
from splatbot.tracking.motion_filter import CameraMotion, MotionFilter
from splatbot.tracking.motion_model import ConstantVelocity, Prediction
from splatbot.tracking.nearby_keyframes import TrackedKeyframe, order_by_distance, pose_distance
from splatbot.tracking.prepare import MIN_DISPLACEMENT, PreparedFrame, displacement, prepare, valid_share
from splatbot.tracking.priors import fill_weak_directions, fuse, is_consistent, mahalanobis_distance
from splatbot.tracking.relocalization import PlaceSearch, RelocalizationCandidate, is_confident
from splatbot.tracking.scheduler import StageScheduler
from splatbot.tracking.stage import TrackingProblem
from splatbot.tracking.stages import StageSet
from splatbot.tracking.uncertainty import Uncertainty, alignment_covariance, world_uncertainty

__all__ = ["PoseEstimate", "TrackedKeyframe", "Tracker", "order_by_distance", "pose_distance"]

Array = NDArray[np.float64]

# Standard deviation of grey (0..1) below which a first image is blank: a covered lens, or a sensor that starts up.
_MIN_GRAY_STD = 0.005

_BEFORE_START = 0.03  # [s] from the pose by which a first frame in motion has its velocity, to this frame
_WORSE = 1.1  # times the lowest residual of the frame: a rectification by a wrong velocity
_MAX_RECTIFICATIONS = 6  # by the velocity that the pose implies; each halves the error of the velocity at least


class Tracker:
    """Estimates the poses of frames; its state is the motion, the uncertainty of keyframes and searches while lost.

    Args:
        config: settings of tracking.
    """

    def __init__(self, config: TrackingConfig) -> None:
        self.config = config
        self.motion = ConstantVelocity()
        self._filter = MotionFilter()
        self._gyroscope = Gyroscope()
        self._lost = False
        self._keyframe_uncertainty: WeakKeyDictionary[Features, Uncertainty] = WeakKeyDictionary()
        self.variance_scale = 1.0
        """Factor on the covariance of poses against keyframes: how much the keyframes contradict each other."""
        self._last_covariance: Array = np.zeros((6, 6))  # of the last pose against its keyframes
        self._costs = None if config.deterministic else CostModel()
        self._stages = StageSet.create()
        self._search = PlaceSearch()
        self._candidate: RelocalizationCandidate | None = None

    def start(self, prepared: PreparedFrame) -> PoseEstimate:
        """Return the pose of the first frame, which defines the world, or "lost" if it is blank or has no depth.

        If the frame has been rectified, the camera moves on with that velocity.
        """
        coverage = valid_share(prepared)
        if coverage < self.config.min_depth_coverage:
            reason = f"only {coverage:.1%} of the pixels have a usable depth"
            return PoseEstimate(np.eye(4), "lost", (reason,), "start")
        if not float(np.nanstd(prepared.levels[0].gray)) >= _MIN_GRAY_STD:
            return PoseEstimate(np.eye(4), "lost", ("the image is blank",), "start")
        stamp, twist = prepared.frame.stamp, prepared.twist if np.any(prepared.twist) else None
        if twist is not None:
            self.motion.update(stamp - _BEFORE_START, se3_exp(-_BEFORE_START * twist))
        self.motion.update(stamp, np.eye(4))
        self._filter.update(CameraMotion.at_pose(stamp, np.eye(4), np.zeros((6, 6)), twist))
        return PoseEstimate(np.eye(4), "ok", (), "start")

    def track(self, prepared: PreparedFrame, keyframes: Sequence[TrackedKeyframe]) -> PoseEstimate:
        """Estimate the pose of a frame; the verdict is "lost" if no hypothesis explains it."""
        frame, T_last, search = prepared.frame, self.motion.T_world_camera, self._search
        motion_prior, robot_prior = self._predict(frame)
        problem = TrackingProblem(self.config, prepared, keyframes, self._lost, T_last, search)
        scheduler = StageScheduler(problem, self._stages, self._costs)
        best = scheduler.best_hypothesis(robot_prior or motion_prior)
        best, trusted_prior, motion_prior = self._check_priors(best, robot_prior, motion_prior, problem, scheduler)
        best = self._weigh_gyroscope(
            self._rectify_again(best, motion_prior.turn, problem, scheduler), motion_prior.turn
        )
        pose, uncertainty = self._fuse_prior(best, trusted_prior, motion_prior)
        pose = self._confirm_relocalization(frame.stamp, pose)
        pose, uncertainty = self._filter_motion(
            pose, uncertainty, best, problem.prepared, trusted_prior, motion_prior.turn
        )
        self._update(frame.stamp, pose, robot_prior)
        return PoseEstimate.create(pose, uncertainty, problem, scheduler.budget, self.motion.velocity)

    @property
    def is_lost(self) -> bool:
        """True if the last frame could not be tracked."""
        return self._lost

    @property
    def awaits_confirmation(self) -> bool:
        """True if the camera was found again, and the next frame must confirm its pose."""
        return self._candidate is not None

    def record_overhead(self, ms: float) -> None:
        """Record the time [ms] that a frame took outside the stages, for the budgets of later frames."""
        if self._costs is not None:
            self._costs.record("overhead", 1, ms)

    def forget(self) -> None:
        """Discard the motion and the search: the next frame may be anywhere in the map."""
        self.motion = ConstantVelocity()
        self._filter.forget()
        self._search.restart()
        self._candidate = None
        self._lost = True

    def move(self, T_new_old: Array) -> None:
        """Move the last pose with a correction (4, 4) of the map at the camera; the velocity stays."""
        self.motion.move(T_new_old)
        self._filter.move(T_new_old)

    def expected_twist(self, stamp: float) -> Array:
        """Return the expected twist (6,) [m/s, rad/s] of the camera at a time [s], to rectify the frame."""
        return self._filter.twist_at(stamp)

    def pose_at(self, stamp: float) -> tuple[Array, Array] | None:
        """Return the pose (4, 4) at a time [s] shortly after the last frame, and the covariance of that frame's pose.

        The covariance (6, 6) is that against the keyframes, of the twist (t [m], ω [rad]) in the camera. It grows with
        the extrapolation: an acceleration a has the standard deviation a dt² / 2. The result is None while the camera
        is lost or its motion is unknown.
        """
        T = None if self._lost else self.motion.extrapolate(stamp)
        return None if T is None else (T, self._last_covariance + self.motion.extrapolation_covariance(stamp))

    def keypoints(self, prepared: PreparedFrame, estimate: PoseEstimate) -> Callable[[], Features]:
        """Return a function that detects the keypoints of a frame that becomes a keyframe, in the calling thread.

        Poses that are estimated with these keypoints inherit the uncertainty of the frame.
        """
        frame, found = prepared.frame, estimate.features

        def find() -> Features:
            n = self.config.n_features
            features = detect(frame.rgb, prepared.depth, frame.camera, n, frame.mask) if found is None else found
            self._keyframe_uncertainty[features] = estimate.uncertainty
            return features

        return find

    def _predict(self, frame: Frame) -> tuple[Prediction, Prediction | None]:
        """Return the motion prior, and the robot prior if the frame has one, which replaces the gyroscope."""
        turn = self._gyroscope.measure(frame.imu, self.motion.stamp, frame.stamp) if frame.prior is None else None
        motion_prior = self.motion.motion_prior(frame.stamp, self._last_covariance, turn)
        if self._candidate is not None:
            motion_prior = replace(motion_prior, T_world_camera=self._candidate.T_world_camera)
        if frame.prior is None:
            return motion_prior, None
        return motion_prior, self.motion.robot_prior(frame.prior, self._last_covariance)

    def _check_priors(
        self,
        best: ScoredHypothesis,
        robot_prior: Prediction | None,
        motion_prior: Prediction,
        problem: TrackingProblem,
        scheduler: StageScheduler,
    ) -> tuple[ScoredHypothesis, Prediction | None, Prediction]:
        """Return the pose, and the robot prior and the motion prior without those that contradict the frame."""
        if robot_prior is not None:
            return *self._check_robot_prior(best, robot_prior, motion_prior, problem, scheduler), motion_prior
        turn = motion_prior.turn
        if turn is None or self._lost:
            return best, None, motion_prior
        plain = self.motion.motion_prior(problem.prepared.frame.stamp, self._last_covariance)
        if not turn.is_doubted and not self._has_turned(best, turn):
            best = _better(scheduler.best_hypothesis(plain), best)
        if best.verdict == "lost" or turn.trust != "new" or self._has_turned(best, turn):
            return best, None, motion_prior
        return best, None, replace(plain, turn=replace(turn, trust="doubted"))

    def _tracked_turn(self, pose: ScoredHypothesis) -> tuple[Array, Array]:
        """Return the rotation (3, 3) from the last pose to a pose, and its covariance (3, 3) [rad²]."""
        R = self.motion.T_world_camera[:3, :3].T @ pose.T_world_camera[:3, :3]
        return R, self.variance_scale * (pose.covariance[3:, 3:] + R.T @ self._last_covariance[3:, 3:] @ R)

    def _weigh_gyroscope(self, pose: ScoredHypothesis, turn: MeasuredTurn | None) -> ScoredHypothesis:
        """Compare a pose with the gyroscope; a pose that contradicts it states this, and is doubted if that is proven.

        The covariance of a doubted pose grows by d² / 3, where 3 is the expectation of χ² with 3 degrees of freedom.
        The filter then corrects the rotation, and the translation by its correlation: on a wall, a wrong rotation is
        paired with a wrong translation.
        """
        if turn is None or self._lost or pose.verdict == "lost" or pose.weak is not None:
            return pose
        self._gyroscope.observe(turn, *self._tracked_turn(pose))
        if self._has_turned(pose, turn):
            return pose
        if turn.trust != "proven":
            return pose.with_reasons("the gyroscope contradicts the rotation: left out")
        scale = turn.distance(*self._tracked_turn(pose)) / 3
        return replace(pose.degraded("the rotation contradicts the gyroscope"), covariance=scale * pose.covariance)

    def _has_turned(self, pose: ScoredHypothesis, turn: MeasuredTurn) -> bool:
        """Return whether a pose has the rotation of the gyroscope, or does not determine its rotation."""
        return pose.verdict != "lost" and (pose.weak is not None or turn.agrees(*self._tracked_turn(pose)))

    def _check_robot_prior(
        self,
        best: ScoredHypothesis,
        robot_prior: Prediction,
        motion_prior: Prediction,
        problem: TrackingProblem,
        scheduler: StageScheduler,
    ) -> tuple[ScoredHypothesis, Prediction | None]:
        """Reject a robot prior that contradicts the frame, and search again from the motion prior without it."""
        view = problem.calibrated_view(self.motion.velocity)
        covariance = self._uncertainty(best).covariance(view) if robot_prior.absolute else best.covariance
        distance = mahalanobis_distance(best, robot_prior, covariance) if best.verdict != "lost" else np.inf
        if is_consistent(distance):
            return best, robot_prior
        best = _better(scheduler.best_hypothesis(motion_prior), best)
        if best.verdict != "lost":
            amount = "far" if not np.isfinite(distance) else f"{distance:.0f} σ"
            best = best.with_reasons(f"the prior is {amount} off: left out")
        return best, None

    def _rectify_again(
        self, best: ScoredHypothesis, turn: MeasuredTurn | None, problem: TrackingProblem, scheduler: StageScheduler
    ) -> ScoredHypothesis:
        """Align the frame again, rectified by the velocity that its pose implies, until its rows stay in place."""
        sensor = self.config.sensor
        predicted = self._predicted(problem.prepared.frame.stamp, best, turn)
        lowest = best.health.score
        for _ in range(_MAX_RECTIFICATIONS):
            prepared = problem.prepared
            twist = self._measured(predicted, best, prepared).twist
            if displacement(prepared, twist, sensor) < MIN_DISPLACEMENT:
                break
            again = scheduler.align_again(prepare(prepared.recorded, self.config, twist), best)
            if again is best:  # no time is left
                break
            loses = again.verdict == "lost" and best.verdict != "lost"
            if loses or again.health.score > _WORSE * lowest:  # the velocity is wrong
                problem.replace_images(prepared, best.T_world_camera)
                break
            best, lowest = again, min(lowest, again.health.score)
        return best

    def _fuse_prior(
        self, best: ScoredHypothesis, robot_prior: Prediction | None, motion_prior: Prediction
    ) -> tuple[ScoredHypothesis, Uncertainty]:
        """Fuse the pose with the robot prior; the motion prior fills weak directions if there is no robot prior."""
        pose = fill_weak_directions(best, robot_prior or motion_prior)
        if robot_prior is None or (pose.weak is not None and robot_prior.absolute):
            return pose, self._uncertainty(pose)
        if robot_prior.absolute:
            known = self._uncertainty(pose)
            T, random = fuse(pose, robot_prior, known.random)
            return pose.with_pose(T, pose.covariance), Uncertainty(random, known.moved, known.turned)
        pose = pose.with_pose(*fuse(pose, robot_prior, pose.covariance))
        return pose, self._uncertainty(pose)

    def _filter_motion(
        self,
        pose: ScoredHypothesis,
        uncertainty: Uncertainty,
        best: ScoredHypothesis,
        prepared: PreparedFrame,
        robot_prior: Prediction | None,
        turn: MeasuredTurn | None = None,
    ) -> tuple[ScoredHypothesis, Uncertainty]:
        """Weigh the pose against the motion so far; a robot prior knows the motion better and keeps the pose.

        In directions that the frame does not constrain, the filter takes its own prediction. ``best`` is the pose
        before these were filled; a filled pose would count the prediction twice.
        """
        if pose.verdict == "lost":
            return pose, uncertainty
        stamp = prepared.frame.stamp
        measures_motion = pose.weak is None and self.config.sensor.readout > 0
        if self._filter.predict(stamp) is None and not measures_motion:
            covariance = self.variance_scale * pose.covariance
            self._filter.update(CameraMotion.at_pose(stamp, pose.T_world_camera, covariance))
            return pose, uncertainty
        measured = pose if robot_prior is not None else best
        state = self._measured(self._predicted(stamp, measured, turn), measured, prepared)
        self._filter.update(state)
        if robot_prior is not None:
            return pose, uncertainty
        against_keyframes = state.covariance[:6, :6] / self.variance_scale  # the uncertainty is scaled again
        pose = pose.with_pose(state.T_world_camera, against_keyframes)
        return pose, self._uncertainty(pose)

    def _predicted(self, stamp: float, pose: ScoredHypothesis, turn: MeasuredTurn | None) -> CameraMotion:
        """Return the predicted motion; after a loss or a long gap it is unknown, and the rows alone measure it."""
        return self._filter.predict(stamp, turn) or CameraMotion.at_pose(stamp, pose.T_world_camera, np.eye(6))

    def _measured(self, predicted: CameraMotion, pose: ScoredHypothesis, prepared: PreparedFrame) -> CameraMotion:
        """Return the state of the motion after the measurement of a pose, and of its rows if no direction is weak."""
        alignment, readout = pose.hypothesis.alignment, self.config.sensor.readout
        if pose.weak is None:
            return predicted.measure(alignment, self.variance_scale * pose.covariance, prepared.twist, readout)
        known = alignment_covariance(pose.weak.known_part(alignment))
        return predicted.measure(alignment, self.variance_scale * known, prepared.twist, 0.0)

    def _uncertainty(self, pose: ScoredHypothesis) -> Uncertainty:
        """Compute the uncertainty of a pose in the world from its own and that of its keyframes."""
        exact, known = Uncertainty(), self._keyframe_uncertainty
        keyframes = [(k.reference.T_world_camera, known.get(k.features, exact)) for k in pose.hypothesis.keyframes]
        return world_uncertainty(pose.T_world_camera, self.variance_scale * pose.covariance, keyframes)

    def _confirm_relocalization(self, stamp: float, pose: ScoredHypothesis) -> ScoredHypothesis:
        """Accept a pose found while lost only if it agrees with that of the previous frame."""
        if not self._lost:
            return pose
        previous, self._candidate = self._candidate, None
        if pose.verdict == "lost":
            return pose
        if not is_confident(pose):
            reasons = (*pose.reasons, "not explained well enough to relocalize")
            return replace(pose, verdict="lost", reasons=reasons)
        if previous is not None and previous.agrees(stamp, pose.T_world_camera):
            return pose
        self._candidate = RelocalizationCandidate(stamp, pose.T_world_camera)
        return replace(pose, verdict="lost", reasons=("found again, the next frame must confirm it",))

    def _update(self, stamp: float, pose: ScoredHypothesis, robot_prior: Prediction | None) -> None:
        """Update the motion model with the pose of the frame, or restart it if the frame is lost."""
        self._lost = pose.verdict == "lost"
        if self._lost:
            self.motion.forget_velocity(robot_prior)
            self._filter.forget()
        else:
            self._search.restart()
            self.motion.update(stamp, pose.T_world_camera)
            self._last_covariance = pose.covariance


def _better(a: ScoredHypothesis, b: ScoredHypothesis) -> ScoredHypothesis:
    """Return the pose that is not lost, or that with the smaller residual; of two equal ones the first."""
    return a if (a.verdict == "lost", a.health.score) <= (b.verdict == "lost", b.health.score) else b

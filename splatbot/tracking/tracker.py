"""Camera tracking of one frame against the keyframes: stages in order of cost, the health check choosing."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from splatbot.config import TrackingConfig
from splatbot.tracking.align import SoftPrior, align
from splatbot.tracking.candidate import Candidate, Judged, judge, score
from splatbot.tracking.estimate import PoseEstimate
from splatbot.tracking.features import Expectation, FeaturePose, Features, detect, match_pose
from splatbot.tracking.health import verdict_of
from splatbot.tracking.predict import ConstantVelocity, Prediction
from splatbot.tracking.prepare import PreparedFrame, valid_share
from splatbot.tracking.priors import fill_weak_directions, fuse, is_believable, sigmas_off
from splatbot.tracking.uncertainty import Uncertainty, world_uncertainty
from splatbot.tracking.views import TrackedKeyframe, nearest, order_by_distance, pose_distance

__all__ = ["PoseEstimate", "TrackedKeyframe", "Tracker", "order_by_distance", "pose_distance"]

Array = NDArray[np.float64]

# A first image whose grey (0..1) varies less is a covered lens or a sensor not up yet: nothing to track against.
_BLANK = 0.005


class Tracker:
    """Finds poses of frames; remembers the last motion, and how well keyframes are known."""

    def __init__(self, config: TrackingConfig) -> None:
        self.config = config
        self.motion = ConstantVelocity()
        self._lost = False
        self._known: WeakKeyDictionary[Features, Uncertainty] = WeakKeyDictionary()
        self._last_covariance: Array = np.zeros((6, 6))  # of the last pose against its keyframes

    def start(self, prepared: PreparedFrame) -> PoseEstimate:
        """The pose of the first frame, which defines the world; "lost" when it has too little depth or is blank."""
        share = valid_share(prepared)
        if share < self.config.min_valid:
            return PoseEstimate(np.eye(4), "lost", (f"only {share:.1%} of the pixels have a usable depth",), "start")
        if not float(np.nanstd(prepared.levels[0].gray)) >= _BLANK:
            return PoseEstimate(np.eye(4), "lost", ("the image is blank",), "start")
        self.motion.update(prepared.frame.stamp, np.eye(4))
        return PoseEstimate(np.eye(4), "ok", (), "start")

    @property
    def is_lost(self) -> bool:
        """Whether the last frame could not be placed."""
        return self._lost

    def forget(self) -> None:
        """The next frame may be anywhere: nothing is known of the motion."""
        self.motion = ConstantVelocity()
        self._lost = True

    def move(self, T_new_old: Array) -> None:
        """The map was moved where the camera is; the motion goes on from there."""
        self.motion.move(T_new_old)

    def remember(self, features: Features, estimate: PoseEstimate) -> None:
        """That the frame with these features becomes a keyframe: poses found with it inherit its uncertainty."""
        self._known[features] = estimate.uncertainty

    def track(self, prepared: PreparedFrame, keyframes: Sequence[TrackedKeyframe]) -> PoseEstimate:
        """The pose of a frame; "lost" when no candidate explains it."""
        clock, frame = Clock(), prepared.frame
        attempt = _Attempt(self.config, prepared, keyframes, clock, self._lost)
        own = self.motion.prediction(frame.stamp, self._last_covariance)
        told = None if frame.prior is None else self.motion.told(frame.prior, self._last_covariance)
        pose = attempt.run(told or own, self.motion.T_world_camera)
        if told is None:
            pose = fill_weak_directions(pose, own)
            uncertainty = self._uncertainty(pose)
        else:
            pose, uncertainty = self._with_prior(attempt, pose, told, own)
        self._conclude(frame.stamp, pose, told)
        return PoseEstimate(
            T_world_camera=pose.T_world_camera,
            verdict=pose.verdict,
            reasons=pose.reasons,
            stage=pose.candidate.stage,
            uncertainty=uncertainty,
            health=pose.health,
            features=attempt.features,
            stage_ms=clock.ms,
        )

    def detect(self, prepared: PreparedFrame) -> Features:
        """Keypoints of a frame, with depth."""
        return detect_in(prepared, self.config.n_features)

    def _with_prior(
        self, attempt: _Attempt, pose: Judged, told: Prediction, own: Prediction
    ) -> tuple[Judged, Uncertainty]:
        """The pose and a prior together; without a prior that what is seen speaks against."""
        against = self._uncertainty(pose).covariance if told.absolute else pose.covariance
        off = sigmas_off(pose, told, against) if pose.verdict != "lost" else np.inf
        if not is_believable(off):
            again = attempt.run(own, self.motion.T_world_camera)
            if (again.verdict == "lost", again.health.score) <= (pose.verdict == "lost", pose.health.score):
                pose = again
            if pose.verdict != "lost":
                said = "far" if not np.isfinite(off) else f"{off:.0f} σ"
                pose = pose.noted(f"the prior is {said} off: left out")
            pose = fill_weak_directions(pose, own)
            return pose, self._uncertainty(pose)
        pose = fill_weak_directions(pose, told)
        if pose.weak is not None and told.absolute:
            return pose, self._uncertainty(pose)
        if told.absolute:
            known = self._uncertainty(pose)
            T, random = fuse(pose, told, known.random)
            return pose.corrected(T, pose.covariance), Uncertainty(random, known.moved, known.turned)
        pose = pose.corrected(*fuse(pose, told, pose.covariance))
        return pose, self._uncertainty(pose)

    def _uncertainty(self, pose: Judged) -> Uncertainty:
        """Of a pose in the world: its own and that of its keyframes."""
        nothing = Uncertainty()
        known = [(v.reference.T_world_camera, self._known.get(v.features, nothing)) for v in pose.candidate.views]
        return world_uncertainty(pose.T_world_camera, pose.covariance, known)

    def _conclude(self, stamp: float, pose: Judged, told: Prediction | None) -> None:
        self._lost = pose.verdict == "lost"
        if self._lost:
            self.motion.forget_velocity(told)
        else:
            self.motion.update(stamp, pose.T_world_camera)
            self._last_covariance = pose.covariance


class _Attempt:
    """The stages on one frame, from one prediction or another."""

    def __init__(
        self,
        config: TrackingConfig,
        prepared: PreparedFrame,
        keyframes: Sequence[TrackedKeyframe],
        clock: Clock,
        lost: bool,
    ) -> None:
        self.config = config
        self.features: Features | None = None
        self._prepared = prepared
        self._keyframes = keyframes
        self._clock = clock
        self._lost = lost

    def run(self, prediction: Prediction, T_before: Array) -> Judged:
        """The best pose from a prediction; ``T_before`` is where the camera was last."""
        with self._clock("geometric"):
            start = self._geometric(prediction)
        matched = None
        if self._needs_features(start, prediction.T_world_camera, T_before):
            with self._clock("features"):
                matched = self._match(start.T_world_camera)
        with self._clock("direct"):
            candidates = [self._direct(start, matched)]
            if matched is not None:
                T = matched.T_world_camera
                candidates.append(self._direct(Candidate("features", start.found.at(T), self._nearest(T)), matched))
        with self._clock("health"):
            return judge(self._prepared, candidates, self.config)

    def _geometric(self, prediction: Prediction) -> Candidate:
        """Projective point-to-plane alignment on the coarse levels, held to the prediction where it sees nothing."""
        views = self._nearest(prediction.T_world_camera)
        found = align(
            self._prepared.levels,
            [view.reference for view in views],
            prediction.T_world_camera,
            self.config,
            photometric=False,
            finest=min(1, len(self._prepared.levels) - 1),
            gate=2 * self.config.gate,
            prior=SoftPrior(prediction.T_world_camera, np.asarray(np.linalg.inv(prediction.covariance), np.float64)),
        )
        return Candidate("geometric", found, views)

    def _direct(self, start: Candidate, matched: FeaturePose | None) -> Candidate:
        """Photometric, depth and feature residuals together, down to the finest level."""
        found = align(
            self._prepared.levels,
            start.references,
            start.T_world_camera,
            self.config,
            photometric=True,
            finest=0,
            gate=self.config.gate,
            features=matched,
            camera=self._prepared.frame.camera,
        )
        return Candidate(f"{start.stage}+direct", found, start.views)

    def _needs_features(self, start: Candidate, T_predicted: Array, T_before: Array) -> bool:
        if self.config.features == "always" or self._lost:
            return True
        moved, turned = pose_distance(T_predicted, T_before)
        if moved > self.config.features_motion or turned > self.config.features_rotation:
            return True
        health = score(self._prepared, start, self.config)
        return verdict_of(health, start.found.information, None, self.config)[0] != "ok"

    def _match(self, T_expected: Array) -> FeaturePose | None:
        """Match with the nearest keyframes, the latest and the first: near to where they are expected, else anywhere.

        When lost, with as many again, and anywhere at once.
        """
        frame, keyframes = self._prepared.frame, self._keyframes
        if self.features is None:
            self.features = detect_in(self._prepared, self.config.n_features)
        n = self.config.match_keyframes * (4 if self._lost else 1)
        chosen = [*order_by_distance(keyframes, T_expected)[:n], 0, len(keyframes) - 1]
        views = [(keyframes[k].features, keyframes[k].reference.T_world_camera) for k in sorted(set(chosen))]
        if not self._lost:
            expected = Expectation(T_expected, self.config.match_radius * frame.camera.width)
            near = match_pose(self.features, views, frame.camera, expected)
            if near is not None and len(near.points) >= self.config.match_enough:
                return near
        return match_pose(self.features, views, frame.camera)

    def _nearest(self, T_world_camera: Array) -> list[TrackedKeyframe]:
        return nearest(self._keyframes, T_world_camera, self.config.reference_keyframes)


def detect_in(prepared: PreparedFrame, n_features: int) -> Features:
    """Keypoints of a frame, with depth, off its mask."""
    frame = prepared.frame
    return detect(frame.rgb, prepared.depth, frame.camera, n_features, frame.mask)


class Clock:
    """Milliseconds by stage."""

    def __init__(self) -> None:
        self.ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.ms[stage] = self.ms.get(stage, 0.0) + 1e3 * (time.perf_counter() - start)

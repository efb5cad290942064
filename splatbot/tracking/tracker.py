"""Camera tracking of one frame against the keyframes: stages in order of cost, the health check choosing."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from splatbot.config import TrackingConfig
from splatbot.tracking.budget import BOLD, CAREFUL, Budget, Costs
from splatbot.tracking.estimate import PoseEstimate
from splatbot.tracking.features import Features, detect
from splatbot.tracking.gicp import GicpStage
from splatbot.tracking.hypothesis import ScoredHypothesis
from splatbot.tracking.motion_model import ConstantVelocity, Prediction
from splatbot.tracking.nearby_keyframes import TrackedKeyframe, order_by_distance, pose_distance
from splatbot.tracking.prepare import PreparedFrame, valid_share
from splatbot.tracking.priors import fill_weak_directions, fuse, is_believable, sigmas_off
from splatbot.tracking.relocalization import PlaceSearch, RelocalizationCandidate, is_sure
from splatbot.tracking.stages import TrackingStages
from splatbot.tracking.uncertainty import Uncertainty, world_uncertainty

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
        self._costs = None if config.deterministic else Costs()
        self._wide = GicpStage(config)
        self._search = PlaceSearch()
        self._sighting: RelocalizationCandidate | None = None

    def start(self, prepared: PreparedFrame) -> PoseEstimate:
        """The pose of the first frame, which defines the world; "lost" when it has too little depth or is blank."""
        share = valid_share(prepared)
        if share < self.config.min_depth_coverage:
            return PoseEstimate(np.eye(4), "lost", (f"only {share:.1%} of the pixels have a usable depth",), "start")
        if not float(np.nanstd(prepared.levels[0].gray)) >= _BLANK:
            return PoseEstimate(np.eye(4), "lost", ("the image is blank",), "start")
        self.motion.update(prepared.frame.stamp, np.eye(4))
        return PoseEstimate(np.eye(4), "ok", (), "start")

    @property
    def is_lost(self) -> bool:
        """Whether the last frame could not be placed."""
        return self._lost

    def note_rest(self, ms: float) -> None:
        """What a frame has cost beside its stages [ms], for the budgets of those to come."""
        if self._costs is not None:
            self._costs.record("rest", 1, ms)

    def forget(self) -> None:
        """The next frame may be anywhere: nothing is known of the motion."""
        self.motion = ConstantVelocity()
        self._lost = True

    def move(self, T_new_old: Array) -> None:
        """The map was moved where the camera is; the motion goes on from there."""
        self.motion.move(T_new_old)

    def keypoints(self, prepared: PreparedFrame, estimate: PoseEstimate) -> Callable[[], Features]:
        """What finds the keypoints of a frame that becomes a keyframe, with depth, in the thread that calls it.

        Poses found with them inherit the frame's uncertainty.
        """
        frame, found = prepared.frame, estimate.features

        def find() -> Features:
            n = self.config.n_features
            features = detect(frame.rgb, prepared.depth, frame.camera, n, frame.mask) if found is None else found
            self._known[features] = estimate.uncertainty
            return features

        return find

    def track(self, prepared: PreparedFrame, keyframes: Sequence[TrackedKeyframe]) -> PoseEstimate:
        """The pose of a frame; "lost" when no candidate explains it."""
        frame, share = prepared.frame, BOLD if self._lost else CAREFUL
        budget = Budget(self.config.budget_ms, self._costs, prepared.started, share)
        budget.count("prepare", frame.camera.width * frame.camera.height)
        search = self._search if self._lost else None
        attempt = TrackingStages(self.config, prepared, keyframes, budget, self._wide, search)
        own = self.motion.prediction(frame.stamp, self._last_covariance)
        if self._sighting is not None:
            own = replace(own, T_world_camera=self._sighting.T_world_camera)
        told = None if frame.prior is None else self.motion.told(frame.prior, self._last_covariance)
        pose = attempt.run(told or own, self.motion.T_world_camera)
        if told is None:
            pose = fill_weak_directions(pose, own)
            uncertainty = self._uncertainty(pose)
        else:
            pose, uncertainty = self._with_prior(attempt, pose, told, own)
        pose = self._conclude(frame.stamp, pose, told)
        return PoseEstimate(
            T_world_camera=pose.T_world_camera,
            verdict=pose.verdict,
            reasons=pose.reasons,
            stage=pose.candidate.stage,
            uncertainty=uncertainty,
            health=pose.health,
            features=attempt.features,
            stage_ms=budget.ms,
            skipped=tuple(budget.skipped),
        )

    def _with_prior(
        self, attempt: TrackingStages, pose: ScoredHypothesis, told: Prediction, own: Prediction
    ) -> tuple[ScoredHypothesis, Uncertainty]:
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

    def _uncertainty(self, pose: ScoredHypothesis) -> Uncertainty:
        """Of a pose in the world: its own and that of its keyframes."""
        nothing = Uncertainty()
        known = [(v.reference.T_world_camera, self._known.get(v.features, nothing)) for v in pose.candidate.views]
        return world_uncertainty(pose.T_world_camera, pose.covariance, known)

    def _conclude(self, stamp: float, pose: ScoredHypothesis, told: Prediction | None) -> ScoredHypothesis:
        """Remember the pose; once lost, only when the next frame agrees with it."""
        if self._lost:
            pose = self._confirmed(stamp, pose)
        self._lost = pose.verdict == "lost"
        if self._lost:
            self.motion.forget_velocity(told)
        else:
            self._search.restart()
            self.motion.update(stamp, pose.T_world_camera)
            self._last_covariance = pose.covariance
        return pose

    def _confirmed(self, stamp: float, pose: ScoredHypothesis) -> ScoredHypothesis:
        """A pose found while lost, if the frame before was found near to it; else it is a sighting, and still lost."""
        before, self._sighting = self._sighting, None
        if pose.verdict == "lost":
            return pose
        if is_sure(pose):
            if before is not None and before.agrees(stamp, pose.T_world_camera):
                return pose
            self._sighting = RelocalizationCandidate(stamp, pose.T_world_camera)
            return replace(pose, verdict="lost", reasons=("found again, the next frame must confirm it",))
        return replace(pose, verdict="lost", reasons=(*pose.reasons, "not explained well enough to begin anew"))

"""Camera tracking of one frame against the keyframes: stages in order of cost, the health check choosing."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from splatbot.config import TrackingConfig
from splatbot.geometry import inverse, so3_log
from splatbot.tracking.align import align
from splatbot.tracking.features import Expectation, FeaturePose, Features, detect, match_pose
from splatbot.tracking.health import Health, Verdict, measure, verdict_of
from splatbot.tracking.predict import ConstantVelocity
from splatbot.tracking.prepare import PreparedFrame, valid_share
from splatbot.tracking.reference import Reference

Array = NDArray[np.float64]

# A first image whose grey (0..1) varies less is a covered lens or a sensor not up yet: nothing to track against.
_BLANK = 0.005


class TrackedKeyframe(Protocol):
    """What the tracker asks of a keyframe."""

    @property
    def features(self) -> Features: ...

    @property
    def reference(self) -> Reference: ...


@dataclass(frozen=True)
class PoseEstimate:
    """Pose of one frame: T_world_camera (4, 4), who found it, and how much it is to be believed."""

    T_world_camera: Array
    verdict: Verdict
    reasons: tuple[str, ...]
    stage: str
    health: Health | None = None
    features: Features | None = None
    stage_ms: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True)
class _Candidate:
    stage: str
    T_world_camera: Array
    information: Array
    references: Sequence[Reference]


class Tracker:
    """Finds poses of frames; remembers only the motion."""

    def __init__(self, config: TrackingConfig) -> None:
        self.config = config
        self.motion = ConstantVelocity()
        self._lost = False

    def start(self, prepared: PreparedFrame) -> PoseEstimate:
        """The pose of the first frame, which defines the world; "lost" when it has too little depth or is blank."""
        share = valid_share(prepared)
        if share < self.config.min_valid:
            return PoseEstimate(np.eye(4), "lost", (f"only {share:.1%} of the pixels have a usable depth",), "start")
        if float(prepared.levels[0].gray.std()) < _BLANK:
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

    def track(self, prepared: PreparedFrame, keyframes: Sequence[TrackedKeyframe]) -> PoseEstimate:
        """The pose of a frame; "lost" when no candidate explains it."""
        clock = _Clock()
        T_predicted = self.motion.predict(prepared.frame.stamp)
        with clock("geometric"):
            candidate = self._geometric(prepared, keyframes, T_predicted)
        features, matched = None, None
        if self._needs_features(prepared, candidate, T_predicted):
            with clock("features"):
                features = self.detect(prepared)
                matched = self._match(features, prepared, keyframes, candidate.T_world_camera)
        with clock("direct"):
            candidates = [self._direct(prepared, candidate, matched)]
            if matched is not None:
                found = self._nearest(keyframes, matched.T_world_camera)
                start = _Candidate("features", matched.T_world_camera, np.zeros((6, 6)), found)
                candidates.append(self._direct(prepared, start, matched))
        with clock("health"):
            best, health = self._choose(prepared, candidates)
            verdict, reasons = verdict_of(health, best.information, self.config)
        self._remember(prepared.frame.stamp, best.T_world_camera, verdict)
        return PoseEstimate(best.T_world_camera, verdict, reasons, best.stage, health, features, clock.ms)

    def detect(self, prepared: PreparedFrame) -> Features:
        """Keypoints of a frame, with depth."""
        return detect(prepared.frame.rgb, prepared.depth, prepared.frame.camera, self.config.n_features)

    def _geometric(
        self, prepared: PreparedFrame, keyframes: Sequence[TrackedKeyframe], T_world_camera: Array
    ) -> _Candidate:
        """Projective point-to-plane alignment on the coarse levels, from the predicted pose."""
        references = self._nearest(keyframes, T_world_camera)
        found = align(
            prepared.levels,
            references,
            T_world_camera,
            self.config,
            photometric=False,
            finest=min(1, len(prepared.levels) - 1),
            gate=2 * self.config.gate,
        )
        return _Candidate("geometric", found.T_world_camera, found.information, references)

    def _direct(self, prepared: PreparedFrame, start: _Candidate, matched: FeaturePose | None) -> _Candidate:
        """Photometric, depth and feature residuals together, down to the finest level."""
        found = align(
            prepared.levels,
            start.references,
            start.T_world_camera,
            self.config,
            photometric=True,
            finest=0,
            gate=self.config.gate,
            features=matched,
            camera=prepared.frame.camera,
        )
        return _Candidate(f"{start.stage}+direct", found.T_world_camera, found.information, start.references)

    def _needs_features(self, prepared: PreparedFrame, candidate: _Candidate, T_predicted: Array) -> bool:
        if self.config.features == "always" or self._lost:
            return True
        moved, turned = pose_distance(T_predicted, self.motion.T_world_camera)
        if moved > self.config.features_motion or turned > self.config.features_rotation:
            return True
        health = self._measure(prepared, candidate)
        return verdict_of(health, candidate.information, self.config)[0] != "ok"

    def _match(
        self, features: Features, prepared: PreparedFrame, keyframes: Sequence[TrackedKeyframe], T_expected: Array
    ) -> FeaturePose | None:
        """Match with the nearest keyframes, the latest and the first: near to where they are expected, else anywhere.

        When lost, with as many again, and anywhere at once.
        """
        n = self.config.match_keyframes * (4 if self._lost else 1)
        chosen = [*order_by_distance(keyframes, T_expected)[:n], 0, len(keyframes) - 1]
        views = [(keyframes[k].features, keyframes[k].reference.T_world_camera) for k in sorted(set(chosen))]
        camera = prepared.frame.camera
        if not self._lost:
            expected = Expectation(T_expected, self.config.match_radius * camera.width)
            near = match_pose(features, views, camera, expected)
            if near is not None and len(near.points) >= self.config.match_enough:
                return near
        return match_pose(features, views, camera)

    def _nearest(self, keyframes: Sequence[TrackedKeyframe], T_world_camera: Array) -> list[Reference]:
        order = order_by_distance(keyframes, T_world_camera)
        return [keyframes[k].reference for k in order[: self.config.reference_keyframes]]

    def _measure(self, prepared: PreparedFrame, candidate: _Candidate) -> Health:
        index = min(1, len(prepared.levels) - 1)
        return measure(prepared.levels[index], index, candidate.references, candidate.T_world_camera, self.config)

    def _choose(self, prepared: PreparedFrame, candidates: Sequence[_Candidate]) -> tuple[_Candidate, Health]:
        measured = [(candidate, self._measure(prepared, candidate)) for candidate in candidates]
        return min(measured, key=lambda pair: pair[1].score)

    def _remember(self, stamp: float, T_world_camera: Array, verdict: Verdict) -> None:
        self._lost = verdict == "lost"
        if self._lost:
            self.motion.forget_velocity()
        else:
            self.motion.update(stamp, T_world_camera)


def pose_distance(T_world_a: Array, T_world_b: Array) -> tuple[float, float]:
    """Distance [m] and angle [rad] between two poses."""
    T_a_b = inverse(T_world_a) @ T_world_b
    return float(np.linalg.norm(T_a_b[:3, 3])), float(np.linalg.norm(so3_log(T_a_b[:3, :3])))


def order_by_distance(keyframes: Sequence[TrackedKeyframe], T_world_camera: Array) -> list[int]:
    """Indices of keyframes, nearest first; one radian counts as half a metre."""

    def distance(k: int) -> float:
        moved, turned = pose_distance(keyframes[k].reference.T_world_camera, T_world_camera)
        return moved + 0.5 * turned

    return sorted(range(len(keyframes)), key=distance)


class _Clock:
    """Milliseconds by stage."""

    def __init__(self) -> None:
        self.ms: dict[str, float] = {}

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        start = time.perf_counter()
        yield
        self.ms[stage] = self.ms.get(stage, 0.0) + 1e3 * (time.perf_counter() - start)

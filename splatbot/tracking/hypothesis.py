"""Pose hypotheses that tracking stages propose, and their scores."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatbot.config import TrackingConfig
from splatbot.tracking.align import Alignment
from splatbot.tracking.degeneracy import WeakDirections, weak_directions
from splatbot.tracking.health import Health, Verdict, measure, verdict_of
from splatbot.tracking.nearby_keyframes import TrackedKeyframe
from splatbot.tracking.prepare import PreparedFrame, typical_depth
from splatbot.tracking.reference import Reference
from splatbot.tracking.uncertainty import alignment_covariance

Array = NDArray[np.float64]

_REFINED = "+direct"


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A pose of the frame that a tracking stage proposes.

    Args:
        stage: names of the stages that led to the pose, joined by "+".
        alignment: the pose with the information of the last alignment.
        keyframes: keyframes that the frame is aligned to.
    """

    stage: str
    alignment: Alignment
    keyframes: Sequence[TrackedKeyframe]

    @property
    def T_world_camera(self) -> Array:
        """Pose (4, 4)."""
        return self.alignment.T_world_camera

    @property
    def references(self) -> list[Reference]:
        """Sampled pixels of the keyframes."""
        return [keyframe.reference for keyframe in self.keyframes]

    @property
    def is_refined(self) -> bool:
        """True if the direct stage has refined the pose."""
        return self.stage.endswith(_REFINED)

    def refined(self, alignment: Alignment) -> Hypothesis:
        """Return the hypothesis with the pose of the direct stage."""
        stage = self.stage if self.is_refined else self.stage + _REFINED
        return replace(self, stage=stage, alignment=alignment)


@dataclass(frozen=True, eq=False)
class ScoredHypothesis:
    """A hypothesis with its health, verdict and covariance.

    Args:
        hypothesis: the pose hypothesis.
        health: agreement of the pose with the frame.
        verdict: "ok", "degraded" or "lost".
        reasons: reasons for a verdict other than "ok".
        weak: directions that the frame does not constrain. If None, it constrains all of them.
        covariance: (6, 6) of the pose against its keyframes, in the camera's frame.
    """

    hypothesis: Hypothesis
    health: Health
    verdict: Verdict
    reasons: tuple[str, ...]
    weak: WeakDirections | None
    covariance: Array

    @property
    def T_world_camera(self) -> Array:
        """Pose (4, 4)."""
        return self.hypothesis.T_world_camera

    def with_pose(self, T_world_camera: Array, covariance: Array) -> ScoredHypothesis:
        """Replace the pose (4, 4) and its covariance (6, 6), e.g. after fusion with a prior."""
        hypothesis = replace(self.hypothesis, alignment=self.hypothesis.alignment.at(T_world_camera))
        return replace(self, hypothesis=hypothesis, covariance=covariance)

    def with_reasons(self, *reasons: str) -> ScoredHypothesis:
        """Append reasons to those of the verdict."""
        return replace(self, reasons=self.reasons + reasons)

    def degraded(self, reason: str) -> ScoredHypothesis:
        """Lower the verdict "ok" to "degraded" and append the reason."""
        return replace(self.with_reasons(reason), verdict="degraded" if self.verdict == "ok" else self.verdict)


def measure_hypothesis(prepared: PreparedFrame, hypothesis: Hypothesis, config: TrackingConfig) -> Health:
    """Measure the health of a hypothesis on the second finest pyramid level."""
    index = min(1, len(prepared.levels) - 1)
    return measure(prepared.levels[index], index, hypothesis.references, hypothesis.T_world_camera, config)


def select_best(prepared: PreparedFrame, hypotheses: Sequence[Hypothesis], config: TrackingConfig) -> ScoredHypothesis:
    """Return the hypothesis with the smallest mean residual, with its verdict and covariance."""
    scored = [(hypothesis, measure_hypothesis(prepared, hypothesis, config)) for hypothesis in hypotheses]
    best, health = min(scored, key=lambda pair: pair[1].score)
    information, weak = best.alignment.information, None
    if np.isfinite(information).all():
        weak = weak_directions(information, typical_depth(prepared), config.min_eigen_ratio)
    verdict, reasons = verdict_of(health, information, weak, config)
    return ScoredHypothesis(best, health, verdict, reasons, weak, alignment_covariance(best.alignment))

"""A pose that some stages propose, and what the health check makes of it."""

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


@dataclass(frozen=True, eq=False)
class Candidate:
    """A pose, the stages that led to it, and the keyframes that it was aligned to."""

    stage: str
    found: Alignment
    views: Sequence[TrackedKeyframe]

    @property
    def T_world_camera(self) -> Array:
        """(4, 4)."""
        return self.found.T_world_camera

    @property
    def references(self) -> list[Reference]:
        """What it was aligned to."""
        return [view.reference for view in self.views]


@dataclass(frozen=True, eq=False)
class ScoredHypothesis:
    """A candidate after the health check.

    Args:
        weak: directions that the frame says nothing of; None where there are none.
        covariance: (6, 6) of the pose against its keyframes, in the camera's frame.
    """

    candidate: Candidate
    health: Health
    verdict: Verdict
    reasons: tuple[str, ...]
    weak: WeakDirections | None
    covariance: Array

    @property
    def T_world_camera(self) -> Array:
        """(4, 4)."""
        return self.candidate.T_world_camera

    def corrected(self, T_world_camera: Array, covariance: Array) -> ScoredHypothesis:
        """The same with a pose and covariance that more than the frame speaks for."""
        candidate = replace(self.candidate, found=self.candidate.found.at(T_world_camera))
        return replace(self, candidate=candidate, covariance=covariance)

    def noted(self, *reasons: str) -> ScoredHypothesis:
        """The same with more reasons."""
        return replace(self, reasons=self.reasons + reasons)

    def doubted(self, reason: str) -> ScoredHypothesis:
        """The same, "degraded" at best, for a reason."""
        return replace(self.noted(reason), verdict="degraded" if self.verdict == "ok" else self.verdict)


def score(prepared: PreparedFrame, candidate: Candidate, config: TrackingConfig) -> Health:
    """How well a candidate explains the frame, on the second finest level."""
    index = min(1, len(prepared.levels) - 1)
    return measure(prepared.levels[index], index, candidate.references, candidate.T_world_camera, config)


def judge(prepared: PreparedFrame, candidates: Sequence[Candidate], config: TrackingConfig) -> ScoredHypothesis:
    """The candidate that explains the frame best, with its verdict and covariance."""
    scored = [(candidate, score(prepared, candidate, config)) for candidate in candidates]
    best, health = min(scored, key=lambda pair: pair[1].score)
    weak = None
    if np.isfinite(best.found.information).all():
        weak = weak_directions(best.found.information, typical_depth(prepared), config.min_eigen_ratio)
    verdict, reasons = verdict_of(health, best.found.information, weak, config)
    return ScoredHypothesis(best, health, verdict, reasons, weak, alignment_covariance(best.found))

"""Result of tracking one frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from splatbot.tracking.budget import Budget
from splatbot.tracking.features import Features
from splatbot.tracking.health import Health, Verdict
from splatbot.tracking.hypothesis import ScoredHypothesis
from splatbot.tracking.prepare import PreparedFrame
from splatbot.tracking.stage import TrackingProblem
from splatbot.tracking.uncertainty import Uncertainty

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Pose of one frame with its verdict and uncertainty.

    Args:
        T_world_camera: (4, 4); the world is the first camera.
        verdict: "ok", "degraded" (tracked, with ``reasons`` for doubt) or "lost".
        reasons: reasons for the verdict, and findings such as a rejected prior.
        stage: stages that led to the pose.
        uncertainty: uncertainty of the pose against the first camera, without errors of calibration.
        covariance: (6, 6) float64 of the twist ξ = (translation [m], rotation [rad]) in the camera's frame, with errors
            of calibration. T_world_camera exp(ξ) is the true pose, where the first camera is the world. It grows along
            the chain of keyframes, and has no meaning if the verdict is "lost".
        health: agreement of the pose with the frame.
        features: keypoints of the frame. If None, no stage has detected them.
        prepared: the images that the pose belongs to. If None, they are those that tracking was given.
        stage_ms: milliseconds by stage.
        skipped: stages that did not fit the remaining time.
    """

    T_world_camera: Array
    verdict: Verdict
    reasons: tuple[str, ...]
    stage: str
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    health: Health | None = None
    features: Features | None = None
    prepared: PreparedFrame | None = None
    stage_ms: dict[str, float] = field(default_factory=dict)
    skipped: tuple[str, ...] = ()

    @classmethod
    def create(
        cls, pose: ScoredHypothesis, uncertainty: Uncertainty, problem: TrackingProblem, budget: Budget, twist: Array
    ) -> PoseEstimate:
        """Create the estimate from the best hypothesis, the time that was spent and the velocity of the camera."""
        return cls(
            T_world_camera=pose.T_world_camera,
            verdict=pose.verdict,
            reasons=pose.reasons,
            stage=pose.hypothesis.stage,
            uncertainty=uncertainty,
            covariance=uncertainty.covariance(problem.calibrated_view(twist)),
            health=pose.health,
            features=problem.features,
            prepared=problem.prepared,
            stage_ms=budget.ms,
            skipped=tuple(budget.skipped),
        )

    @property
    def cost_ms(self) -> float:
        """Milliseconds of all stages."""
        return sum(self.stage_ms.values())

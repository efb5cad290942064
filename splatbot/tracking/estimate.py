"""What tracking says of one frame."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from splatbot.tracking.features import Features
from splatbot.tracking.health import Health, Verdict
from splatbot.tracking.uncertainty import Uncertainty

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PoseEstimate:
    """Pose of one frame, who found it, and how much it is to be believed.

    Args:
        T_world_camera: (4, 4); the world is the first camera.
        verdict: "ok", "degraded" (tracked, with ``reasons`` to doubt it) or "lost".
        reasons: what speaks against the pose, or was found wrong on the way to it.
        stage: the stages that led to it.
        uncertainty: of the pose; see :attr:`covariance`.
        health: how well it explains the frame.
        features: keypoints of the frame, where they were looked for.
        stage_ms: milliseconds by stage.
        skipped: stages that there was no time for.
    """

    T_world_camera: Array
    verdict: Verdict
    reasons: tuple[str, ...]
    stage: str
    uncertainty: Uncertainty = field(default_factory=Uncertainty)
    health: Health | None = None
    features: Features | None = None
    stage_ms: dict[str, float] = field(default_factory=dict)
    skipped: tuple[str, ...] = ()

    @property
    def covariance(self) -> Array:
        """(6, 6) float64 of the twist ξ = (translation [m], rotation [rad]) in the camera's frame.

        T_world_camera exp(ξ) is the true pose, where the first camera is the world. It grows along the chain of
        keyframes. Meaningless where the verdict is "lost".
        """
        return self.uncertainty.covariance

    @property
    def cost_ms(self) -> float:
        """Milliseconds of all stages."""
        return sum(self.stage_ms.values())

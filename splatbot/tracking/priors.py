"""What was known before the frame, put together with what the frame says."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.geometry import inverse, se3_exp, se3_log
from splatbot.tracking.hypothesis import ScoredHypothesis
from splatbot.tracking.motion_model import Prediction
from splatbot.tracking.uncertainty import alignment_covariance

Array = NDArray[np.float64]

# 99.99 % of right priors lie nearer to the pose than this squared Mahalanobis distance (χ², 6 degrees of freedom).
_GATE = 27.86


def fill_weak_directions(pose: ScoredHypothesis, prediction: Prediction) -> ScoredHypothesis:
    """In directions that the frame says nothing of, the prediction and its covariance; elsewhere the pose as it is.

    Solution remapping (Zhang, Kaess and Singh 2016), with the covariance that follows from it.
    """
    if pose.weak is None or pose.verdict == "lost":
        return pose
    weak = np.eye(6) - pose.weak.strong
    off = se3_log(inverse(pose.T_world_camera) @ prediction.T_world_camera)
    known = alignment_covariance(pose.weak.known_part(pose.candidate.found))
    P = pose.weak.strong
    covariance = P @ known @ P.T + weak @ prediction.covariance @ weak.T
    return pose.corrected(pose.T_world_camera @ se3_exp(weak @ off), covariance)


def sigmas_off(pose: ScoredHypothesis, told: Prediction, covariance: Array) -> float:
    """Mahalanobis distance of a prior from a pose with a covariance (6, 6)."""
    off = se3_log(inverse(pose.T_world_camera) @ told.T_world_camera)
    return float(np.sqrt(off @ np.linalg.solve(covariance + told.covariance, off)))


def is_believable(sigmas: float) -> bool:
    """Whether a prior that far from what was seen may be right."""
    return sigmas**2 <= _GATE


def fuse(pose: ScoredHypothesis, told: Prediction, covariance: Array) -> tuple[Array, Array]:
    """T_world_camera (4, 4) and covariance (6, 6) of a pose with a covariance (6, 6) and a prior together.

    One Gauss-Newton step from the pose with the prior as a factor: the pose is where the alignment's own gradient is 0.
    """
    off = se3_log(inverse(pose.T_world_camera) @ told.T_world_camera)
    gain = np.linalg.solve(covariance + told.covariance, covariance).T
    fused = covariance - gain @ covariance
    return pose.T_world_camera @ se3_exp(gain @ off), 0.5 * (fused + fused.T)

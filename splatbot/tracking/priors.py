"""Fusion of the estimated pose with the motion prior and the robot prior."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.geometry import inverse, se3_exp, se3_log
from splatbot.tracking.hypothesis import ScoredHypothesis
from splatbot.tracking.motion_model import Prediction
from splatbot.tracking.uncertainty import alignment_covariance

Array = NDArray[np.float64]

_CHI2_GATE = 27.86  # 99.99 % quantile of χ² with 6 degrees of freedom


def fill_weak_directions(pose: ScoredHypothesis, prediction: Prediction) -> ScoredHypothesis:
    """Take the prediction in directions that the frame does not constrain, and the pose in all others.

    Solution remapping (Zhang, Kaess and Singh, "On degeneracy of optimization-based state estimation problems", ICRA
    2016). P is the projection on the constrained directions, δ = log(T⁻¹ T_prediction)::

        T' = T exp((I - P) δ)
        Σ' = P Σ Pᵀ + (I - P) Σ_prediction (I - P)ᵀ
    """
    if pose.weak is None or pose.verdict == "lost":
        return pose
    weak = np.eye(6) - pose.weak.strong
    delta = se3_log(inverse(pose.T_world_camera) @ prediction.T_world_camera)
    known = alignment_covariance(pose.weak.known_part(pose.hypothesis.alignment))
    P = pose.weak.strong
    covariance = P @ known @ P.T + weak @ prediction.covariance @ weak.T
    return pose.with_pose(pose.T_world_camera @ se3_exp(weak @ delta), covariance)


def mahalanobis_distance(pose: ScoredHypothesis, prior: Prediction, covariance: Array) -> float:
    """Compute the Mahalanobis distance [σ] between a prior and a pose with a covariance (6, 6).

    d² = δᵀ (Σ + Σ_prior)⁻¹ δ with δ = log(T⁻¹ T_prior).
    """
    delta = se3_log(inverse(pose.T_world_camera) @ prior.T_world_camera)
    return float(np.sqrt(delta @ np.linalg.solve(covariance + prior.covariance, delta)))


def is_consistent(distance: float) -> bool:
    """Return True if a Mahalanobis distance [σ] passes the χ² gate: 1 in 10 000 correct priors fails it."""
    return distance**2 <= _CHI2_GATE


def fuse(pose: ScoredHypothesis, prior: Prediction, covariance: Array) -> tuple[Array, Array]:
    """Fuse a pose of a covariance (6, 6) with a prior, and return T_world_camera (4, 4) and covariance (6, 6).

    One Gauss-Newton step from the pose with the prior as a factor; the alignment's own gradient is zero at the pose. In
    the form of a Kalman update with δ = log(T⁻¹ T_prior)::

        K = Σ (Σ + Σ_prior)⁻¹
        T' = T exp(K δ)
        Σ' = Σ - K Σ
    """
    delta = se3_log(inverse(pose.T_world_camera) @ prior.T_world_camera)
    gain = np.linalg.solve(covariance + prior.covariance, covariance).T
    fused = covariance - gain @ covariance
    return pose.T_world_camera @ se3_exp(gain @ delta), 0.5 * (fused + fused.T)

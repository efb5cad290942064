"""Consistency of pose covariances: normalized estimation error squared, NEES (Bar-Shalom et al. 2001)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import InputError
from splatbot.evaluation.trajectory import MAX_DIFFERENCE, associate
from splatbot.geometry import inverse, se3_log
from splatbot.trajectory import Trajectory

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Consistency:
    """Normalized errors of a trajectory: NEES / 6 = ξᵀ C⁻¹ ξ / 6, 1 in the mean for correct covariances.


    Args:
        mean: over the frames. It exceeds 1 if the covariances are too small.
        median: over the frames; 0.89 for Gaussian errors.
        stamps: (M,) [s].
        values: (M,) ξᵀ C⁻¹ ξ / 6.
    """

    mean: float
    median: float
    stamps: Array
    values: Array


def nees(
    reference: Trajectory,
    estimate: Trajectory,
    covariances: Array,
    *,
    reference_covariance: Array | None = None,
    max_difference: float = MAX_DIFFERENCE,
) -> Consistency:
    """Compare pose errors with their covariances by NEES / 6 = ξᵀ C⁻¹ ξ / 6.

    The trajectories are aligned by their first common frame, which is left out of the result. The error
    ξ = log(T_estimated⁻¹ T_true) is a twist (translation [m], rotation [rad]) in the camera frame.

    Args:
        reference: true poses.
        estimate: estimated poses, N of them.
        covariances: (N, 6, 6) of the estimate's ξ.
        reference_covariance: (6, 6) of the reference's own error, added to each. If None, the reference is exact.
        max_difference: largest difference [s] of the stamps of associated frames.

    Raises:
        InputError: fewer than two frames can be associated, shapes differ, or a covariance is not positive definite.
    """
    if covariances.shape != (len(estimate), 6, 6):
        raise InputError(
            f"have shape {covariances.shape} for {len(estimate)} poses.", field="covariances", hint="give (N, 6, 6)"
        )
    of_reference, of_estimate = associate(reference, estimate, max_difference)
    if len(of_reference) < 2:
        raise InputError("only one frame can be associated.", field="stamps", hint="a normalised error needs two")
    truth, poses = reference.T_world_camera[of_reference], estimate.T_world_camera[of_estimate]
    T_estimate_reference = poses[0] @ inverse(truth[0])
    extra = np.zeros((6, 6)) if reference_covariance is None else reference_covariance
    values = []
    for T_true, T, C in zip(truth[1:], poses[1:], covariances[of_estimate][1:] + extra, strict=True):
        if not np.isfinite(C).all() or np.linalg.eigvalsh(C)[0] <= 0:
            raise InputError("one is not positive definite.", field="covariances", hint="give covariances of full rank")
        error = se3_log(inverse(T) @ T_estimate_reference @ T_true)
        values.append(float(error @ np.linalg.solve(C, error)) / 6)
    return Consistency(
        float(np.mean(values)), float(np.median(values)), estimate.stamps[of_estimate[1:]], np.array(values)
    )

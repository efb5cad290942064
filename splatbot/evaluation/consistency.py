"""Consistency of pose covariances: normalized estimation error squared, NEES (Bar-Shalom et al. 2001)."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import least_squares

from splatbot.errors import InputError
from splatbot.evaluation.trajectory import MAX_DIFFERENCE, associate
from splatbot.geometry import inverse, se3_exp, se3_log
from splatbot.spacing import evenly_spaced
from splatbot.trajectory import Trajectory

Array = NDArray[np.float64]

_FITTED_FRAMES = 200  # of a long trajectory, by which the mount is fitted
_MOUNT_SIGMA = np.repeat([0.05, np.radians(3.0)], 3)  # [m, rad] of the error of a reference's mount before the fit


@dataclass(frozen=True, eq=False)
class Consistency:
    """Normalized errors of a trajectory: NEES / 6 = ξᵀ C⁻¹ ξ / 6, 1 in the mean for correct covariances.

    Args:
        mean: over the frames. It exceeds 1 if the covariances are too small.
        median: over the frames; 0.89 for Gaussian errors.
        stamps: (M,) [s].
        values: (M,) ξᵀ C⁻¹ ξ / 6.
        T_reference_camera: (4, 4) pose of the camera in the frame whose poses the reference holds, if it was fitted.
    """

    mean: float
    median: float
    stamps: Array
    values: Array
    T_reference_camera: Array = field(default_factory=lambda: np.eye(4))


def nees(
    reference: Trajectory,
    estimate: Trajectory,
    covariances: Array,
    *,
    fit_mount: bool = False,
    reference_covariance: Array | None = None,
    max_difference: float = MAX_DIFFERENCE,
) -> Consistency:
    """Compare pose errors with their covariances by NEES / 6 = ξᵀ C⁻¹ ξ / 6.

    The error ξ = log(T_estimated⁻¹ A T_true B) is a twist (translation [m], rotation [rad]) in the camera frame. A
    reference that is sampled as densely as the estimate is interpolated at its stamps. The first common frame is left
    out of the result, because it defines the world of the estimate.

    Without ``fit_mount``, A aligns the first common frame and B is the identity. With it, A and B minimise Σ ξᵀ C⁻¹ ξ,
    with a robust loss and a prior of B. Motion capture and arms follow a body that carries the camera. The calibration
    of this mount is often wrong by a degree.

    Args:
        reference: true poses.
        estimate: estimated poses, N of them.
        covariances: (N, 6, 6) of the estimate's ξ.
        fit_mount: whether the camera's pose in the frame of the reference, B, is estimated.
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
    stamps, poses = estimate.stamps[of_estimate], estimate.T_world_camera[of_estimate]
    truth = _at_stamps(reference, of_reference, stamps, max_difference)
    extra = np.zeros((6, 6)) if reference_covariance is None else reference_covariance
    whitening = np.array([_whitening(C) for C in covariances[of_estimate][1:] + extra])
    A, B = poses[0] @ inverse(truth[0]), np.eye(4)
    if fit_mount:
        A, B = _fitted(truth[1:], poses[1:], whitening, A)
    errors = _normalized(truth[1:], poses[1:], whitening, A, B)
    values = (errors**2).sum(axis=1) / 6
    return Consistency(float(np.mean(values)), float(np.median(values)), stamps[1:], values, B)


def _whitening(C: Array) -> Array:
    """Return W (6, 6) with Wᵀ W = C⁻¹."""
    if not np.isfinite(C).all() or np.linalg.eigvalsh(C)[0] <= 0:
        raise InputError("one is not positive definite.", field="covariances", hint="give covariances of full rank")
    return np.asarray(np.linalg.inv(np.linalg.cholesky(C)), dtype=np.float64)


def _normalized(truth: Array, poses: Array, whitening: Array, A: Array, B: Array) -> Array:
    """Return W ξ (N, 6) of the frames."""
    errors = [se3_log(inverse(T) @ A @ T_true @ B) for T_true, T in zip(truth, poses, strict=True)]
    return np.asarray(np.einsum("nij,nj->ni", whitening, np.array(errors)), dtype=np.float64)


def _fitted(truth: Array, poses: Array, whitening: Array, A: Array) -> tuple[Array, Array]:
    """Return A and B (4, 4) by robust least squares on evenly spaced frames; A is the first estimate."""
    rows = list(evenly_spaced(range(len(poses)), _FITTED_FRAMES))
    truth, poses, whitening = truth[rows], poses[rows], whitening[rows]

    def residuals(x: Array) -> Array:
        errors = _normalized(truth, poses, whitening, A @ se3_exp(x[:6]), se3_exp(x[6:]))
        return np.concatenate([errors.ravel(), x[6:] / _MOUNT_SIGMA])

    x = least_squares(residuals, np.zeros(12), loss="soft_l1", f_scale=3.0, max_nfev=50).x
    return A @ se3_exp(x[:6]), se3_exp(x[6:])


def _at_stamps(reference: Trajectory, nearest: NDArray[np.intp], stamps: Array, max_difference: float) -> Array:
    """Return the poses (M, 4, 4) of the reference at the stamps, or the nearest ones where its samples are sparse."""
    poses = reference.T_world_camera[nearest].copy()
    for i, stamp in enumerate(stamps):
        after = int(np.searchsorted(reference.stamps, stamp))
        if not 0 < after < len(reference):
            continue
        begin, end = reference.stamps[after - 1], reference.stamps[after]
        if end - begin <= 2 * max_difference:
            T_begin, T_end = reference.T_world_camera[after - 1], reference.T_world_camera[after]
            step = se3_log(inverse(T_begin) @ T_end) * (stamp - begin) / (end - begin)
            poses[i] = T_begin @ se3_exp(step)
    return poses

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

_FITTED_FRAMES = 100  # of a long trajectory, by which the mount is fitted
_LEAST_FRAMES = 10  # for 12 unknowns
_LONGEST_STEP = 0.1  # [s] between two samples of a reference that is interpolated
_THREE_SIGMA = 20.06  # of ξᵀ C⁻¹ ξ, which 99.73 % of normally distributed errors with 6 dimensions do not exceed
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

    @property
    def within_three_sigma(self) -> float:
        """Share of the frames with ξᵀ C⁻¹ ξ below its 99.73 % quantile; 0.9973 for Gaussian errors."""
        return float(np.mean(6 * self.values < _THREE_SIGMA))


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

    The error ξ = log(T_estimated⁻¹ A T_true B) is a twist (translation [m], rotation [rad]) in the camera frame. The
    reference is interpolated between samples of at most 0.1 s apart. Two kinds of frames are left out
    of the result. A aligns the first common one, and those with a zero covariance define the world.

    Without ``fit_mount``, A aligns the first common frame and B is the identity. With it, A and B minimise Σ ξᵀ C⁻¹ ξ,
    with a robust loss and a prior of B. As they take 12 of the 6 M dimensions, values are divided by 1 - 2 / M. Motion
    capture and arms follow a body that carries the camera. The calibration of this mount is often wrong by a degree.

    Args:
        reference: true poses.
        estimate: estimated poses, N of them.
        covariances: (N, 6, 6) of the estimate's ξ.
        fit_mount: whether the camera's pose in the frame of the reference, B, is estimated.
        reference_covariance: (6, 6) of the reference's own error, added to each. If None, the reference is exact.
        max_difference: largest difference [s] of the stamps of associated frames.

    Raises:
        InputError: fewer than two frames can be associated, or ten for ``fit_mount``; shapes differ, or a covariance is
            not positive definite.
    """
    if covariances.shape != (len(estimate), 6, 6):
        raise InputError(
            f"have shape {covariances.shape} for {len(estimate)} poses.", field="covariances", hint="give (N, 6, 6)"
        )
    common = np.unique(associate(reference, estimate, max_difference)[1])  # a dense reference has several of a frame
    if len(common) < 2:
        raise InputError("only one frame can be associated.", field="stamps", hint="a normalised error needs two")
    truth = _at_stamps(reference, estimate.stamps[common])
    A, B = estimate.T_world_camera[common[0]] @ inverse(truth[0]), np.eye(4)
    uncertain = np.flatnonzero(covariances[common[1:]].any(axis=(1, 2))) + 1
    truth, rows = truth[uncertain], common[uncertain]
    if len(rows) < (_LEAST_FRAMES if fit_mount else 1):
        hint = f"a fitted mount needs {_LEAST_FRAMES}" if fit_mount else "a normalised error needs one"
        raise InputError(f"{len(rows)} frames with a covariance can be associated.", field="stamps", hint=hint)
    extra = np.zeros((6, 6)) if reference_covariance is None else reference_covariance
    poses, whitening = estimate.T_world_camera[rows], np.array([_whitening(C) for C in covariances[rows] + extra])
    if fit_mount:
        A, B = _fitted(truth, poses, whitening, A)
    values = (_normalized(truth, poses, whitening, A, B) ** 2).sum(axis=1) / 6
    values /= 1 - 2 / len(rows) if fit_mount else 1
    return Consistency(float(np.mean(values)), float(np.median(values)), estimate.stamps[rows], values, B)


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

    x = least_squares(residuals, np.zeros(12), loss="soft_l1", f_scale=3.0, max_nfev=25).x
    return A @ se3_exp(x[:6]), se3_exp(x[6:])


def _at_stamps(reference: Trajectory, stamps: Array) -> Array:
    """Return the poses (M, 4, 4) of the reference at the stamps; at ends and in gaps, those of the nearest samples."""
    poses = []
    for stamp in stamps:
        after = int(np.clip(np.searchsorted(reference.stamps, stamp), 1, max(len(reference) - 1, 1)))
        rows = [after - 1, min(after, len(reference) - 1)]
        (begin, end), (T_begin, T_end) = reference.stamps[rows], reference.T_world_camera[rows]
        share = (stamp - begin) / (end - begin) if end > begin else 0.0
        if not 0 <= share <= 1 or end - begin > _LONGEST_STEP:
            share = float(share > 0.5)
        poses.append(T_begin @ se3_exp(share * se3_log(inverse(T_begin) @ T_end)))
    return np.array(poses)

"""Covariance of a pose from the residuals of its alignment and from the keyframes that it is aligned to."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from splatbot.config import SensorConfig
from splatbot.geometry import adjoint, inverse, so3_log
from splatbot.tracking.align import Alignment

Array = NDArray[np.float64]


@dataclass(frozen=True)
class UncertaintyConstants:
    """Empirical constants of the covariance. Larger values increase it; docs/experiments/tracking.md has the NEES."""

    min_information: float = 1e-3
    """Information [1/m²] and [1/rad²] of any pose: alignment finds it within about 30 m of its start."""
    image_shift: float = 0.025
    """Standard deviation [px] of a shift of the whole image by interpolation and blur. It is common to all cells, so
    the spread between them does not contain it."""
    cell_correlation: float = 1.25
    """Factor [1] on the spread, because the errors of adjacent cells are correlated."""


CONSTANTS = UncertaintyConstants()


@dataclass(frozen=True, eq=False)
class CalibratedView:
    """Quantities of a frame by which errors of calibration become errors of its pose.

    Args:
        sensor: ``stamp_sigma`` [s], ``image_sigma`` [px] and ``calibration_error`` [1].
        twist: (6,) velocity [m/s, rad/s] of the camera in its own frame.
        depth: typical depth [m].
        focal: focal length [px].
    """

    sensor: SensorConfig
    twist: Array
    depth: float
    focal: float


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """Uncertainty of T_world_camera, where the world is the first camera.

    Args:
        random: (6, 6) covariance of the twist ξ = (translation [m], rotation [rad]) in the camera's frame for which
            T_world_camera exp(ξ) is the true pose, without the error of calibration.
        moved: length [m] of the chain of keyframes from the first one to the camera.
        turned: angle [rad] of the rotations along this chain.
    """

    random: Array = field(default_factory=lambda: np.zeros((6, 6)))
    moved: float = 0.0
    turned: float = 0.0

    def covariance(self, view: CalibratedView) -> Array:
        """Return the covariance (6, 6) of the same twist with the errors of calibration, which do not average out.

        With the length l and the angle α of the chain, the camera's velocity ϖ, the depth z and the focal length f::

            C = Σ_random + σ_stamp² ϖ ϖᵀ + diag(a, a, a, b, b, b)
            a = (c l)² / 3 + (σ_image z / f)²
            b = (c α)² / 3 + (σ_image / f)²

        The relative error c is ``calibration_error``.
        """
        sensor = view.sensor
        shift = (sensor.calibration_error * self.moved) ** 2 / 3 + (sensor.image_sigma * view.depth / view.focal) ** 2
        turn = (sensor.calibration_error * self.turned) ** 2 / 3 + (sensor.image_sigma / view.focal) ** 2
        along_motion = sensor.stamp_sigma**2 * np.outer(view.twist, view.twist)
        return self.random + along_motion + np.diag([shift] * 3 + [turn] * 3)


def alignment_covariance(alignment: Alignment) -> Array:
    """Compute the covariance (6, 6) of a pose against its references, of the twist (t [m], ω [rad]) in the camera.

    The cluster-robust sandwich estimator (Huber 1967; Liang and Zeger 1986) treats the n cells of the image as
    clusters: residuals within a cell are correlated. With the curvature C of the robust cost, the gradient g_k of the
    residuals in cell k and the information H of the noise model::

        S = Σ_k g_k g_kᵀ
        Σ = (6/n)² H⁻¹ + f n/(n - 6) C⁻¹ S C⁻¹ + Σ_shift

    The factor n/(n - 6) corrects for few clusters, and f is ``CONSTANTS.cell_correlation``. H⁻¹ replaces the estimate
    if the cells are too few for it. Σ_shift is a shift of the whole image, expressed as a rotation about each axis. The
    covariance is large but finite in directions without information. It is NaN if H is not finite.
    """
    if not np.isfinite(alignment.information).all():
        return np.full((6, 6), np.nan)
    p, cells = CONSTANTS, alignment.cells
    few_clusters = p.cell_correlation * cells / max(cells - 6, 1)
    model_share = min(1.0, (6 / max(cells, 1)) ** 2)
    model = np.linalg.inv(alignment.information + p.min_information * np.eye(6))
    C_inverse = np.linalg.inv(alignment.curvature + p.min_information * np.eye(6))
    shift = np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]) * (p.image_shift / alignment.focal) ** 2
    sandwich = few_clusters * C_inverse @ alignment.spread @ C_inverse
    return _symmetric(np.asarray(model_share * model + sandwich + shift, dtype=np.float64))


def world_uncertainty(
    T_world_camera: Array, against_references: Array, references: Sequence[tuple[Array, Uncertainty]]
) -> Uncertainty:
    """Compute the uncertainty of a pose in the world from its covariance against keyframes and from theirs.

    Each of the n keyframes contributes an equal part of the pose. The bound cov(Σ ξ_k / n) ≤ Σ cov(ξ_k) / n holds for
    any correlation between them, so with the adjoint A_k of T_camera_keyframe::

        Σ_world = Σ + Σ_k A_k Σ_k A_kᵀ / n

    Args:
        T_world_camera: (4, 4).
        against_references: (6, 6) covariance of the pose against the keyframes.
        references: T_world_keyframe (4, 4) and uncertainty of each keyframe.
    """
    random, moved, turned = against_references.copy(), 0.0, 0.0
    for T_world_keyframe, known in references:
        T_camera_keyframe = inverse(T_world_camera) @ T_world_keyframe
        A = adjoint(T_camera_keyframe)
        random += A @ known.random @ A.T / len(references)
        moved += (known.moved + float(np.linalg.norm(T_camera_keyframe[:3, 3]))) / len(references)
        turned += (known.turned + float(np.linalg.norm(so3_log(T_camera_keyframe[:3, :3])))) / len(references)
    return Uncertainty(_symmetric(random), moved, turned)


def _symmetric(covariance: Array) -> Array:
    return 0.5 * (covariance + covariance.T)

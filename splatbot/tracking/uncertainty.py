"""How far a pose may be from the truth: from the residuals of its alignment, and from the keyframes it rests on."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from splatbot.geometry import adjoint, inverse, so3_log
from splatbot.tracking.align import Alignment

Array = NDArray[np.float64]

# Information that any pose has: it is within some 30 m and turns of where it was looked for.
_LEAST = 1e-3
# An image cannot be placed on another more exactly [px]: interpolation and blur shift all of it, which no cell shows.
_PLACEMENT = 0.025
# Neighbouring cells err together in part, so the spread says less than there is by this factor.
_BETWEEN_CELLS = 1.25
# Calibration of lens and depth is good to this share: such an error is the same in every frame, so along a path it adds
# up, and does not average out.
_CALIBRATION = 0.07e-3


@dataclass(frozen=True, eq=False)
class Uncertainty:
    """How well T_world_camera is known, where the world is the first camera.

    Args:
        random: (6, 6) covariance of the twist ξ = (translation [m], rotation [rad]) in the camera's frame for which
            T_world_camera exp(ξ) is the true pose; of what differs from frame to frame.
        moved: length [m] of the chain of keyframes from the first one to here.
        turned: the same of rotations [rad].
    """

    random: Array = field(default_factory=lambda: np.zeros((6, 6)))
    moved: float = 0.0
    turned: float = 0.0

    @property
    def covariance(self) -> Array:
        """(6, 6) of the same twist, errors of calibration included."""
        shift, turn = (_CALIBRATION * self.moved) ** 2 / 3, (_CALIBRATION * self.turned) ** 2 / 3
        return self.random + np.diag([shift] * 3 + [turn] * 3)


def alignment_covariance(found: Alignment) -> Array:
    """Covariance (6, 6) of a pose against its references, twist (t [m], ω [rad]) in the camera's frame.

    Cluster-robust (Huber 1967; Liang and Zeger 1986) over the n cells of the image, with the factor for few clusters:
    C⁻¹ S C⁻¹ n/(n - 6), C the curvature and S the spread; plus the noise model's own H⁻¹, whose share (6/n)² is all of
    it where cells are too few to tell, plus a shift of the whole image, taken for a turn about each axis. Where H says
    nothing the covariance is large, and finite; NaN where H is.
    """
    if not np.isfinite(found.information).all():
        return np.full((6, 6), np.nan)
    few = _BETWEEN_CELLS * found.cells / max(found.cells - 6, 1)
    share = min(1.0, (6 / max(found.cells, 1)) ** 2)
    model = np.linalg.inv(found.information + _LEAST * np.eye(6))
    C_inverse = np.linalg.inv(found.curvature + _LEAST * np.eye(6))
    shift = np.diag([0.0, 0.0, 0.0, 1.0, 1.0, 1.0]) * (_PLACEMENT / found.focal) ** 2
    return _symmetric(np.asarray(share * model + few * C_inverse @ found.spread @ C_inverse + shift, dtype=np.float64))


def world_uncertainty(
    T_world_camera: Array, against_references: Array, references: Sequence[tuple[Array, Uncertainty]]
) -> Uncertainty:
    """Uncertainty in the world of a pose of known covariance (6, 6) against keyframes (T_world_keyframe, its own).

    The keyframes' errors are taken as if each carried an equal part of the pose: cov(Σ ξ/n) ≤ Σ cov(ξ)/n, whatever
    they have in common.
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

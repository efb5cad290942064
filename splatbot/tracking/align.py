"""Gauss-Newton alignment of a frame to keyframes, for the geometric stage, the direct stage and loop closure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from splatbot import _native
from splatbot.camera import Camera
from splatbot.config import TrackingConfig
from splatbot.geometry import inverse
from splatbot.tracking.features import FeaturePose
from splatbot.tracking.prepare import Level
from splatbot.tracking.reference import Reference, ReferencePoints

Array = NDArray[np.float64]

# Number of pixels per reference for which ``dense_weight`` is calibrated. More pixels add no independent measurements,
# so their total weight is that of this number.
_CALIBRATED_PIXELS = 4800

_SHARP = np.zeros(6)


@dataclass(frozen=True)
class Alignment:
    """Pose that an alignment converged to, with its information.

    Args:
        T_world_camera: (4, 4).
        information: (6, 6) Gauss-Newton matrix H of the twist (t [m], ω [rad]) that left-multiplies T_camera_world. It
            is that of the last step, without the information of a prior.
        curvature: (6, 6) second derivative of the robust cost at the pose. Outliers make it smaller than H.
        spread: (6, 6) sum of g gᵀ over the image cells, where g is the gradient of the residuals in one cell.
        cells: number of image cells with residuals.
        focal: focal length [px] of the finest level.
        band_information: (B, 6, 6) Gauss-Newton matrices of the residuals in B bands of image rows, top to bottom.
        band_gradient: (B, 6) their gradients.
    """

    T_world_camera: Array
    information: Array
    curvature: Array
    spread: Array
    cells: int
    focal: float
    band_information: Array = field(default_factory=lambda: np.zeros((0, 6, 6)))
    band_gradient: Array = field(default_factory=lambda: np.zeros((0, 6)))

    @classmethod
    def unconstrained(cls, T_world_camera: Array) -> Alignment:
        """Return a pose (4, 4) without any measurement."""
        return cls(T_world_camera, np.zeros((6, 6)), np.zeros((6, 6)), np.zeros((6, 6)), 0, 1.0)

    def at(self, T_world_camera: Array) -> Alignment:
        """Return the same information at another pose (4, 4)."""
        return replace(self, T_world_camera=T_world_camera)


@dataclass(frozen=True)
class SoftPrior:
    """Gaussian prior of the pose in the normal equations.

    Args:
        T_world_camera: (4, 4).
        information: (6, 6) of the twist (t [m], ω [rad]) in the camera's frame, zero in unknown directions.
    """

    T_world_camera: Array
    information: Array


def settings_of(
    config: TrackingConfig, *, photometric: bool, gate: float, depth_sigma_scale: float = 1.0, blur: Array = _SHARP
) -> _native.AlignSettings:
    """Return the noise model of the native kernels; ``depth_sigma_scale`` multiplies the σ of depth."""
    sensor = config.sensor
    return _native.AlignSettings(
        photometric=photometric,
        geometric=True,
        sigma_gray=sensor.sigma_gray,
        sigma_depth_floor=depth_sigma_scale * sensor.sigma_depth_floor,
        sigma_depth_quad=depth_sigma_scale * sensor.sigma_depth_quad,
        gate=gate,
        blur=blur.tolist(),
    )


@dataclass(frozen=True)
class Residuals:
    """Residuals of the sampled pixels of a reference at a pose.

    Args:
        photometric: (N,) residual of grey over its σ, NaN for points outside the view.
        geometric: (N,) point-to-plane residual over its σ, NaN for points without depth.
        gain: fitted exposure gain.
        offset: fitted exposure offset in grey 0..1.
    """

    photometric: NDArray[np.float32]
    geometric: NDArray[np.float32]
    gain: float
    offset: float


def residuals(level: Level, points: ReferencePoints, T_camera_reference: Array, config: TrackingConfig) -> Residuals:
    """Compute the residuals of a reference at a pose (4, 4) on one level, with the exposure fitted to them."""
    settings = settings_of(config, photometric=True, gate=config.sensor.max_depth_difference)
    arrays = (*_level_arrays(level), *_point_arrays(points), T_camera_reference)
    return Residuals(*_native.align_residuals(*arrays, settings))


def align(
    levels: Sequence[Level],
    references: Sequence[Reference],
    T_world_camera: Array,
    config: TrackingConfig,
    *,
    photometric: bool,
    finest: int,
    gate: float,
    features: FeaturePose | None = None,
    camera: Camera | None = None,
    prior: SoftPrior | None = None,
    blur: Array = _SHARP,
) -> Alignment:
    """Align a frame to references from the coarsest level to the finest.

    A sampled pixel i of a reference has a point p_i, a normal n_i and grey c_i. The pose T = (R, t) projects it to the
    pixel π(T p_i), where the frame has grey I and the back-projected point q. The residuals are point-to-plane (Chen
    and Medioni 1992), photometric with exposure (a, b) (Kerl et al. 2013), and the reprojection of feature matches::

        r_geometric,i = (R n_i) · (T p_i - q) / σ_z
        r_photometric,i = (I(π(T p_i)) - a c_i - b) / σ_gray
        r_match,j = (π(T p_j) - u_j) / σ_j

    The weights of Student's t, ν = 4, make it an iteratively reweighted least-squares problem (Kerl et al. 2013). Each
    Gauss-Newton step solves the normal equations, and updates T by a left increment. Λ is the information of an
    optional prior and e its residual::

        w(r) = (ν + 1) / (ν + r²)
        (Σ w J Jᵀ + Λ) δ = -(Σ w J r + Λ e)
        T ← exp(δ) T

    Dense residuals are correlated between neighbouring pixels: blur, rolling shutter, depth of another instant. So each
    of them has the weight ``config.dense_weight`` relative to a feature match. The photometric alignment multiplies the
    σ of depth by ``config.sensor.depth_sigma_scale``, because errors of calibration are common to all pixels.

    Args:
        levels: pyramid of the frame, finest level first.
        references: sampled pixels of the keyframes.
        T_world_camera: (4, 4) initial pose.
        config: settings of tracking.
        photometric: True for photometric and geometric residuals, False for geometric residuals alone.
        finest: index of the last level.
        gate: largest difference of depth [m] between a point and its projection on the same surface.
        features: matches of features. If None, no reprojection residuals are used.
        camera: camera of the features' pixels.
        prior: Gaussian prior of the pose. If None, the pose is not constrained by one.
        blur: (6,) standard deviation β (translation [m], rotation [rad]) of the motion by which a blurred image may be
            displaced. The variance of a residual with the Jacobian J becomes σ² + (J β)².
    """
    matches = None
    if features is not None and camera is not None:
        matches = (features.points, features.pixels, features.sigmas, _intrinsics(camera))
    scale = config.sensor.depth_sigma_scale if photometric else 1.0
    T_camera_world, information, curvature, spread, cells, _, _, band_information, band_gradient = _native.align(
        [_level_arrays(level) for level in levels],
        [(r.T_world_camera, [_point_arrays(points) for points in r.levels]) for r in references],
        matches,
        None if prior is None else (inverse(prior.T_world_camera), prior.information),
        inverse(T_world_camera),
        settings_of(config, photometric=photometric, gate=gate, depth_sigma_scale=scale, blur=blur),
        config.dense_weight * _CALIBRATED_PIXELS / config.n_pixels,
        config.iterations,
        finest,
        config.dense_share if photometric else 0.0,
    )
    focal = levels[finest].camera.fx
    return Alignment(
        inverse(T_camera_world), information, curvature, spread, cells, focal, band_information, band_gradient
    )


def _level_arrays(level: Level) -> tuple[NDArray[np.float32], NDArray[np.float32], tuple[float, float, float, float]]:
    return level.gray, level.depth, _intrinsics(level.camera)


def _point_arrays(points: ReferencePoints) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    return points.points, points.normals, points.gray


def _intrinsics(camera: Camera) -> tuple[float, float, float, float]:
    return camera.fx, camera.fy, camera.cx, camera.cy

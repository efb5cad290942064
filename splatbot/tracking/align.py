"""Alignment of a frame to keyframes by Gauss-Newton: the loop that the geometric and the direct stage share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

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


@dataclass(frozen=True)
class Alignment:
    """What an alignment found.

    Args:
        T_world_camera: (4, 4).
        information: (6, 6) of the twist (t [m], ω [rad]) that left-multiplies T_camera_world, at the last step, as
            the noise model has it; a prior's left out.
        curvature: (6, 6) of the robust cost at the pose: less than the information by what outlying residuals lack.
        spread: (6, 6) sum of g gᵀ over the cells of the image, g the gradient of the residuals in one cell.
        cells: how many cells have residuals.
        focal: focal length [px] of the finest level that it used.
    """

    T_world_camera: Array
    information: Array
    curvature: Array
    spread: Array
    cells: int
    focal: float

    def at(self, T_world_camera: Array) -> Alignment:
        """The same numbers at another pose."""
        return replace(self, T_world_camera=T_world_camera)


_FULL_PIXELS = 4800  # of a reference that ``dense_weight`` is meant for


@dataclass(frozen=True)
class SoftPrior:
    """What is known of T_world_camera (4, 4) before a frame is looked at.

    Args:
        T_world_camera: (4, 4).
        information: (6, 6) of the twist (t [m], ω [rad]) in the camera's frame; zero in directions it knows nothing of.
    """

    T_world_camera: Array
    information: Array


def settings_of(config: TrackingConfig, *, photometric: bool, gate: float, doubt: float = 1.0) -> _native.AlignSettings:
    """The noise model as the kernels take it, with depth ``doubt`` times as uncertain; geometric residuals are on."""
    return _native.AlignSettings(
        photometric=photometric,
        geometric=True,
        sigma_gray=config.sensor.sigma_gray,
        sigma_depth_floor=doubt * config.sensor.sigma_depth_floor,
        sigma_depth_quad=doubt * config.sensor.sigma_depth_quad,
        gate=gate,
    )


@dataclass(frozen=True)
class Residuals:
    """Residuals of a reference at a pose, r/σ (N,) of grey and of depth, NaN where there is none; exposure fitted."""

    photometric: NDArray[np.float32]
    geometric: NDArray[np.float32]
    gain: float
    offset: float


def residuals(level: Level, points: ReferencePoints, T_camera_reference: Array, config: TrackingConfig) -> Residuals:
    """How well a pose explains a level; only exposure is fitted."""
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
) -> Alignment:
    """Align a frame to references, coarse to fine, in C++.

    Dense residuals are correlated between neighbouring pixels (blur, rolling shutter, depth registered a moment
    earlier), so they count ``config.dense_weight`` each, against reprojected features (``features`` with the
    ``camera`` of their pixels), which count one over their variance [px²]. More pixels measure the same better; they
    bring no more that is independent, so together they weigh as 4800 do. Beside colour, depth is taken for
    ``config.sensor.depth_sigma_scale`` times as uncertain as its pixels' noise.
    """
    matches = None
    if features is not None and camera is not None:
        matches = (features.points, features.pixels, features.sigmas, _intrinsics(camera))
    doubt = config.sensor.depth_sigma_scale if photometric else 1.0
    T_camera_world, information, curvature, spread, cells, *_ = _native.align(
        [_level_arrays(level) for level in levels],
        [(r.T_world_camera, [_point_arrays(points) for points in r.levels]) for r in references],
        matches,
        None if prior is None else (inverse(prior.T_world_camera), prior.information),
        inverse(T_world_camera),
        settings_of(config, photometric=photometric, gate=gate, doubt=doubt),
        config.dense_weight * _FULL_PIXELS / config.n_pixels,
        config.iterations,
        finest,
        config.dense_share if photometric else 0.0,
    )
    return Alignment(inverse(T_camera_world), information, curvature, spread, cells, levels[finest].camera.fx)


def _level_arrays(level: Level) -> tuple[NDArray[np.float32], NDArray[np.float32], tuple[float, float, float, float]]:
    return level.gray, level.depth, _intrinsics(level.camera)


def _point_arrays(points: ReferencePoints) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    return points.points, points.normals, points.gray


def _intrinsics(camera: Camera) -> tuple[float, float, float, float]:
    return camera.fx, camera.fy, camera.cx, camera.cy

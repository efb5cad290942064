"""Gauss-Newton alignment of a frame to keyframes: the loop that the geometric and the direct stage share."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot import _native
from splatbot.camera import Camera
from splatbot.config import TrackingConfig
from splatbot.geometry import inverse, se3_exp, transform_points
from splatbot.tracking.features import FeaturePose
from splatbot.tracking.prepare import Level
from splatbot.tracking.reference import Reference

Array = NDArray[np.float64]

# Exposure is anchored weakly to gain 1 and offset 0, so that a blank image leaves it defined.
_EXPOSURE_PRIOR = 1e2 * np.eye(2)
_EXPOSURE_NEUTRAL = np.array([1.0, 0.0])
_STEP_DONE = 1e-5  # [m] and [rad]
_DAMPING = 1e-5  # share of the mean diagonal


@dataclass
class NormalEquations:
    """Sums over residuals for the twist (t [m], ω [rad]) that left-multiplies T_camera_world: H (6, 6), g (6,)."""

    H: Array
    g: Array

    @classmethod
    def zero(cls) -> NormalEquations:
        return cls(np.zeros((6, 6)), np.zeros(6))

    def solve(self) -> Array:
        """The damped Gauss-Newton step (6,); zero where there is no information."""
        damping = _DAMPING * np.trace(self.H) / 6.0
        if not damping > 0:
            return np.zeros(6)
        return -np.linalg.solve(self.H + damping * np.eye(6), self.g)


class DenseTerm:
    """Photometric and depth residuals of one reference on one level, with that pair's own exposure."""

    def __init__(self, reference: Reference, level: Level, index: int, config: TrackingConfig, gate: float) -> None:
        self.points = reference.levels[index]
        self.T_world_reference = reference.T_world_camera
        self.level = level
        self.config = config
        self.gate = gate
        self.exposure = _EXPOSURE_NEUTRAL.copy()

    def linearize(
        self, T_camera_world: Array, *, photometric: bool, geometric: bool
    ) -> tuple[Array, Array, Array, Array]:
        """H (8, 8) and g (8,) over twist and exposure, and the residuals r/σ (N,) of colour and depth, NaN: none."""
        c = self.level.camera
        H, g, _, _, r_photo, r_geo = _native.linearize_alignment(
            self.level.gray,
            self.level.depth,
            (c.fx, c.fy, c.cx, c.cy),
            self.points.points,
            self.points.normals,
            self.points.gray,
            T_camera_world @ self.T_world_reference,
            *self.exposure,
            photometric,
            geometric,
            self.config.sigma_gray,
            self.config.sigma_depth_floor,
            self.config.sigma_depth_quad,
            self.gate,
        )
        return H, g, r_photo, r_geo

    def add_marginal(self, total: NormalEquations, T_camera_world: Array, weight: float, photometric: bool) -> None:
        """Add this term to ``total``, exposure marginalised (Schur complement); remember how exposure would follow."""
        H, g, _, _ = self.linearize(T_camera_world, photometric=photometric, geometric=True)
        A = H[6:, 6:] + _EXPOSURE_PRIOR
        b = g[6:] + _EXPOSURE_PRIOR @ (self.exposure - _EXPOSURE_NEUTRAL)
        gain = H[:6, 6:] @ np.linalg.inv(A)
        total.H += weight * (H[:6, :6] - gain @ H[6:, :6])
        total.g += weight * (g[:6] - gain @ b)
        self._follow = (A, H[6:, :6], b)

    def update_exposure(self, step: Array) -> None:
        """Back-substitute the exposure that belongs to a twist step (6,)."""
        A, B, b = self._follow
        self.exposure -= np.linalg.solve(A, b + B @ step)


def add_features(total: NormalEquations, T_camera_world: Array, features: FeaturePose, camera: Camera) -> None:
    """Add reprojection residuals, σ = 1 px, Student-t weights, of the matches that RANSAC kept."""
    q = transform_points(T_camera_world, features.points)
    seen = q[:, 2] > 1e-3
    q, pixels = q[seen], features.pixels[seen]
    r = camera.project(q) - pixels  # (M, 2)
    w = 5.0 / (4.0 + (r**2).sum(1))
    iz, zero = 1.0 / q[:, 2], np.zeros(len(q))
    rows_u = np.stack([camera.fx * iz, zero, -camera.fx * q[:, 0] * iz**2], 1)
    rows_v = np.stack([zero, camera.fy * iz, -camera.fy * q[:, 1] * iz**2], 1)
    for rows, residual in ((rows_u, r[:, 0]), (rows_v, r[:, 1])):
        J = np.concatenate([rows, np.cross(q, rows)], axis=1)  # (M, 6)
        total.H += (J * w[:, None]).T @ J
        total.g += J.T @ (w * residual)


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
) -> tuple[Array, Array]:
    """Align a frame to references, coarse to fine; returns T_world_camera (4, 4) and information (6, 6).

    Dense residuals are correlated between neighbouring pixels (blur, rolling shutter, depth registered a moment
    earlier), so they count ``config.dense_weight`` each, against reprojected features (``features`` with the
    ``camera`` of their pixels), which count one.
    """
    T_camera_world = inverse(T_world_camera)
    total = NormalEquations.zero()
    for index in reversed(range(finest, len(levels))):
        terms = [DenseTerm(r, levels[index], index, config, gate) for r in references]
        for _ in range(config.iterations):
            total = NormalEquations.zero()
            for term in terms:
                term.add_marginal(total, T_camera_world, config.dense_weight, photometric)
            if features is not None and camera is not None:
                add_features(total, T_camera_world, features, camera)
            step = total.solve()
            T_camera_world = se3_exp(step) @ T_camera_world
            for term in terms:
                term.update_exposure(step)
            if max(np.abs(step)) < _STEP_DONE:
                break
    return inverse(T_camera_world), total.H

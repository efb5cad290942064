"""Depth fusion: a depth image supports Gaussians, moves them along their normals, or shows free space instead."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatbot.camera import Camera
from splatbot.config import TrackingConfig
from splatbot.gaussians import GaussianModel
from splatbot.gaussians.shape import shortest_axes
from splatbot.geometry import inverse, quat_multiply
from splatbot.mapping.normals import smooth_normals
from splatbot.mapping.pixels import pixels_of


@dataclass(frozen=True)
class DepthFusionConstants:
    """Constants of depth fusion.

    Args:
        gate_sigma: [σ] up to this difference, a measured depth and a Gaussian belong to one surface.
        least_gate_share: [share of depth] lower limit of that difference. It covers errors of calibration and pose.
        grazing_cosine: below this cosine of ray and normal, depth hardly constrains the surface.
        least_sigma_ratio: lower limit of the map's σ over that of one measurement. Measurements from one viewpoint
            share errors, and below the limit the map would not follow new ones.
        normal_window: [px] half the side of the window that a normal is fitted to.
        same_surface_cosine: below this cosine, a measured normal belongs to another surface.
        least_normal_gain: lower limit of the weight of a measured normal.
        guessed_sigma_share: [share of depth] standard deviation of a guessed depth.
        miss_log_odds: decrease of a Gaussian's log-odds of existence with each observation through it.
        stable_observations: number of supporting observations of a stable Gaussian.
        stable_sigma_share: [share of width] largest standard deviation of the mean of a stable Gaussian.
        removal_misses, unstable_removal_misses: misses, net of support, that remove a stable or another Gaussian.
        removed_logit: opacity logit that lets pruning remove a Gaussian.
    """

    gate_sigma: float = 3.0
    least_gate_share: float = 0.012
    grazing_cosine: float = 0.2
    least_sigma_ratio: float = 0.3
    normal_window: int = 6
    same_surface_cosine: float = 0.7
    least_normal_gain: float = 0.1
    guessed_sigma_share: float = 0.05
    miss_log_odds: float = 1.0
    stable_observations: int = 3
    stable_sigma_share: float = 0.5
    removal_misses: int = 3
    unstable_removal_misses: int = 2
    removed_logit: float = -10.0


CONSTANTS = DepthFusionConstants()


@dataclass(frozen=True)
class DepthNoiseModel:
    """Standard deviation of measured depth, σ_z = floor + quad z² [m] (after Nguyen et al. 2012)."""

    floor: float
    quad: float

    @classmethod
    def of(cls, config: TrackingConfig) -> DepthNoiseModel:
        """Return the noise model of the configured sensor."""
        return cls(config.sensor.sigma_depth_floor, config.sensor.sigma_depth_quad)

    def __call__(self, depth: Tensor) -> Tensor:
        """Compute the standard deviation [m] of measured depths [m]."""
        return self.floor + self.quad * depth.square()


@dataclass(frozen=True)
class DepthComparison:
    """Comparison of each Gaussian with a depth image.

    Args:
        supported: (N,) the measured surface is at the Gaussian.
        seen_through: (N,) the measured surface is farther, at the pixel of the Gaussian's center and all around it.
        offset: (N,) [m] from the mean to the measured surface along ``normals``; 0 where not supported.
        variance: (N,) [m²] of that measurement; inf without information.
        normals: (N, 3) shortest axes in the world frame; zero without a measurement.
        measured_normals: (N, 3) of the measured surface, in the world frame; zero without information.
    """

    supported: Tensor
    seen_through: Tensor
    offset: Tensor
    variance: Tensor
    normals: Tensor
    measured_normals: Tensor


@torch.no_grad()
def compare_with_depth(
    model: GaussianModel, depth: Tensor, camera: Camera, T_world_camera: NDArray[np.float64], noise: DepthNoiseModel
) -> DepthComparison:
    """Compare every Gaussian with the depth measured along the ray r of its center's pixel.

    Depth z and a Gaussian belong to one surface if |z - z_μ| < max(3 √(σ_z² + σ_μ²), 0.012 z). The offset is
    d = nᵀ (z r - μ) along the normal n. It uses the ray of the pixel: the center of a slanted disc may lie next to it.
    The variance of the offset is R = (σ_z nᵀ r)².

    Args:
        depth: (H, W) [m], 0 missing, as observed by ``camera``.
        T_world_camera: (4, 4).
    """
    T_camera_world = torch.from_numpy(inverse(T_world_camera)).float()
    points = model.means @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    rays, row, column, inside = _rays(camera, points)
    rows = (inside & (depth[row, column] > 0)).nonzero()[:, 0]  # depth neither supports nor contradicts the others
    points, rays, row, column = points[rows], rays[rows], row[rows], column[rows]
    z, farther = depth[row, column], _least_depth_around(depth)[row, column]
    normals = shortest_axes(model, rows)
    facing = normals @ T_camera_world[:3, :3].T
    sigma = noise(z)
    spread = (sigma.square() + model.uncertainty[rows].square()).sqrt()
    tolerance = torch.maximum(CONSTANTS.gate_sigma * spread, CONSTANTS.least_gate_share * z)
    supported = (points[:, 2] - z).abs() < tolerance
    slant = (facing * rays).sum(1)
    offset = (facing * (rays * z[:, None] - points)).sum(1)
    cosine = slant.abs() / rays.norm(dim=1)
    informative = supported & (cosine > CONSTANTS.grazing_cosine) & (offset.abs() < tolerance)
    window = CONSTANTS.normal_window
    around = torch.from_numpy(smooth_normals(depth.numpy(), camera, row.numpy(), column.numpy(), window)).float()
    measured_normals = torch.where(informative[:, None], around, 0.0) @ T_camera_world[:3, :3]
    return DepthComparison(
        supported=_scattered(len(model), rows, supported),
        seen_through=_scattered(len(model), rows, (farther > 0) & (points[:, 2] + tolerance < farther)),
        offset=_scattered(len(model), rows, torch.where(informative, offset, 0.0)),
        variance=_scattered(len(model), rows, torch.where(informative, (sigma * slant).square(), torch.inf), torch.inf),
        normals=_scattered(len(model), rows, normals),
        measured_normals=_scattered(len(model), rows, measured_normals),
    )


def fuse_depth(model: GaussianModel, comparison: DepthComparison) -> GaussianModel:
    """Return the model after a Kalman update of the means along their normals.

    With the variance P of the mean and R of the measurement, the gain is K = P / (P + R). The mean becomes
    μ' = μ + K d n, with the offset d along the normal n, and the variance P' = (1 - K) P, that is 1/P' = 1/P + 1/R.
    P' stays above 0.3² R, because measurements from one viewpoint share errors.
    """
    P, R = model.uncertainty.square(), comparison.variance
    gain = torch.where(torch.isinf(R), 0.0, P / (P + R))
    means = model.means + (gain * comparison.offset)[:, None] * comparison.normals
    fused = torch.where(torch.isinf(R), P, torch.maximum(P * (1 - gain), CONSTANTS.least_sigma_ratio**2 * R))
    return replace(model, means=means, uncertainty=torch.minimum(fused, P).sqrt())


def fuse_normals(model: GaussianModel, comparison: DepthComparison) -> GaussianModel:
    """Return the model with shortest axes rotated towards the measured normals, to the mean of all observations.

    n' = normalize(n + g (n* - n)), with the gain g = max(1 / (1 + observations), 0.1). A single
    measured normal is wrong by up to 10°. A disc of 3 cm with that tilt leaves its surface by 5 mm.
    """
    cosine = (comparison.normals * comparison.measured_normals).sum(1)
    rows = (cosine.abs() > CONSTANTS.same_surface_cosine).nonzero()[:, 0]
    normals, toward = comparison.normals[rows], cosine[rows].sign()[:, None] * comparison.measured_normals[rows]
    gain = (1.0 / (1.0 + model.observations[rows])).clamp_min(CONSTANTS.least_normal_gain)
    target = torch.nn.functional.normalize(normals + gain[:, None] * (toward - normals), dim=1)
    # The quaternion of the shortest rotation from a to b is (1 + aᵀb, a × b), normalized.
    turn = torch.cat([1 + (normals * target).sum(1, keepdim=True), normals.cross(target, dim=1)], 1)
    turned = torch.from_numpy(quat_multiply(torch.nn.functional.normalize(turn, dim=1), model.quats[rows])).float()
    return replace(model, quats=model.quats.index_copy(0, rows, turned))


def update_visibility(model: GaussianModel, comparison: DepthComparison) -> GaussianModel:
    """Return the model with observations and misses counted and the opacity of missed Gaussians reduced.

    Each miss subtracts 1 from the opacity logit, the log-odds update of occupancy mapping (Hornung et al. 2013, Eq. 2).
    A miss removes a guessed Gaussian at once. It takes three misses, net of support, to remove a :func:`stable` one and
    two to remove another.
    """
    limit = torch.where(stable(model), CONSTANTS.removal_misses, CONSTANTS.unstable_removal_misses)
    supported, through = comparison.supported, comparison.seen_through
    misses = torch.where(supported, (model.misses - 1).clamp_min(0), model.misses + through.int())
    logits = model.opacity_logits - CONSTANTS.miss_log_odds * through.float()
    logits[(through & (model.observations == 0)) | (misses >= limit)] = CONSTANTS.removed_logit
    return replace(model, observations=model.observations + supported.int(), misses=misses, opacity_logits=logits)


def stable(model: GaussianModel) -> Tensor:
    """Return which Gaussians (N,) are well measured: three observations, and σ of the mean below half their width."""
    width = model.log_scales.median(1).values.exp()
    return (model.observations >= CONSTANTS.stable_observations) & (
        model.uncertainty < CONSTANTS.stable_sigma_share * width
    )


def initial_uncertainty(model: GaussianModel, T_world_camera: NDArray[np.float64], noise: DepthNoiseModel) -> Tensor:
    """Compute σ (N,) [m] of new Gaussians: that of the sensor, or a share of the depth where it was guessed."""
    T_camera_world = torch.from_numpy(inverse(T_world_camera)).float()
    z = model.means @ T_camera_world[2, :3] + T_camera_world[2, 3]
    return torch.where(model.observations > 0, noise(z), CONSTANTS.guessed_sigma_share * z)


def _rays(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Project points (N, 3) of the camera frame: rays (N, 3) of z = 1 of their pixels, rows, columns, if inside."""
    u, v, inside = pixels_of(camera, points)
    rays = torch.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, torch.ones_like(u)], 1)
    return rays, v.long(), u.long(), inside


def _least_depth_around(depth: Tensor) -> Tensor:
    """Compute the least depth (H, W) of each pixel's 3x3 neighbors: 0 where one of them is missing."""
    return torch.from_numpy(cv2.erode(depth.numpy(), np.ones((3, 3), np.uint8)))


def _scattered(count: int, rows: Tensor, values: Tensor, rest: float = 0.0) -> Tensor:
    """Return (count, ...) values: ``values`` (M, ...) at ``rows`` (M,), ``rest`` elsewhere."""
    return values.new_full((count, *values.shape[1:]), rest).index_copy_(0, rows, values)

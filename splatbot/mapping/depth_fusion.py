"""What a depth image says of Gaussians that are there: that they are where it is, how far off, or that they are not."""

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

_GATE = 3.0  # standard deviations up to which depth and Gaussian are of one surface
_LEAST_GATE = 0.012  # [share of depth] the same at least: calibration and pose are not the sensor's noise
_GRAZING = 0.2  # cosine below which depth says little of where a surface is
_LEAST_GAIN = 0.3  # σ of the map over σ of one measurement: below it the map would cease to learn
_REACH = 6  # [px] half the side of the window to which a normal is fitted
_SAME_SIDE = 0.7  # cosine below which a measured normal is that of another surface
_LEAST_TURN = 0.1  # share of a new normal in the mean of all
_GUESS = 0.05  # σ of a guessed depth [share of it]
_DOUBT = 1.0  # odds of a Gaussian fall by e with each look through it
_STABLE_LOOKS, _STABLE_WIDTH = 3, 0.5  # support, and share of its width below which σ of its mean is, of a stable one
_GONE, _GONE_UNSTABLE = 3, 2  # looks through it, net of support, after which a Gaussian goes


@dataclass(frozen=True)
class DepthNoiseModel:
    """σ_z = floor + quad z² [m]."""

    floor: float
    quad: float

    @classmethod
    def of(cls, config: TrackingConfig) -> DepthNoiseModel:
        """The sensor's, as tracking has it."""
        return cls(config.sensor.sigma_depth_floor, config.sensor.sigma_depth_quad)

    def __call__(self, depth: Tensor) -> Tensor:
        """Standard deviation [m] of measured depths [m]."""
        return self.floor + self.quad * depth.square()


@dataclass(frozen=True)
class DepthComparison:
    """What a depth image says of each Gaussian.

    Args:
        supported: (N,) measured where it is.
        seen_through: (N,) something farther was measured, at its centre's pixel and all around.
        offset: (N,) [m] from the mean to the measured surface along ``normals``; 0 where not supported.
        variance: (N,) [m²] of that measurement; inf where it says nothing.
        normals: (N, 3) shortest axes in the world frame; zero where nothing was measured.
        measured_normals: (N, 3) of the measured surface there, in the world frame; zero where it says nothing.
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
    """Compare every Gaussian with what was measured along its centre's ray.

    Depth and Gaussian are of one surface up to 3 σ of both, or 1.2 % of the depth. The distance is taken from the
    pixel's own point, along the Gaussian's normal: the centre of a slanted disc need not lie on the pixel's centre.

    Args:
        depth: (H, W) [m], 0 missing, as seen by ``camera`` at ``T_world_camera`` (4, 4).
    """
    T_camera_world = torch.from_numpy(inverse(T_world_camera)).float()
    points = model.means @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
    rays, row, column, inside = _rays(camera, points)
    rows = (inside & (depth[row, column] > 0)).nonzero()[:, 0]  # the others are neither borne out nor contradicted
    points, rays, row, column = points[rows], rays[rows], row[rows], column[rows]
    z, farther = depth[row, column], _nearest_around(depth)[row, column]
    normals = shortest_axes(model, rows)
    facing = normals @ T_camera_world[:3, :3].T
    sigma = noise(z)
    tolerance = torch.maximum(_GATE * (sigma.square() + model.uncertainty[rows].square()).sqrt(), _LEAST_GATE * z)
    supported = (points[:, 2] - z).abs() < tolerance
    slant = (facing * rays).sum(1)
    offset = (facing * (rays * z[:, None] - points)).sum(1)
    cosine = slant.abs() / rays.norm(dim=1)
    useful = supported & (cosine > _GRAZING) & (offset.abs() < tolerance)
    around = torch.from_numpy(smooth_normals(depth.numpy(), camera, row.numpy(), column.numpy(), _REACH)).float()
    return DepthComparison(
        supported=_of_all(len(model), rows, supported),
        seen_through=_of_all(len(model), rows, (farther > 0) & (points[:, 2] + tolerance < farther)),
        offset=_of_all(len(model), rows, torch.where(useful, offset, 0.0)),
        variance=_of_all(len(model), rows, torch.where(useful, (sigma * slant).square(), torch.inf), torch.inf),
        normals=_of_all(len(model), rows, normals),
        measured_normals=_of_all(len(model), rows, torch.where(useful[:, None], around, 0.0) @ T_camera_world[:3, :3]),
    )


def fuse_depth(model: GaussianModel, evidence: DepthComparison) -> GaussianModel:
    """The model with means moved along their normals by a Kalman filter, and with what that leaves uncertain.

    With P the variance of the mean and R that of the measurement, the mean moves by P / (P + R) of the offset and P
    becomes P R / (P + R), the information form of which is Λ += 1 / R; but P stays above a share of R, for measurements
    from one place err together.
    """
    P, R = model.uncertainty.square(), evidence.variance
    gain = torch.where(torch.isinf(R), 0.0, P / (P + R))
    means = model.means + (gain * evidence.offset)[:, None] * evidence.normals
    fused = torch.where(torch.isinf(R), P, torch.maximum(P * (1 - gain), _LEAST_GAIN**2 * R))
    return replace(model, means=means, uncertainty=torch.minimum(fused, P).sqrt())


def fuse_normals(model: GaussianModel, evidence: DepthComparison) -> GaussianModel:
    """The model with shortest axes turned towards the measured normals, so that they become the mean of all looks.

    A disc of 3 cm that is tilted by 10° reaches 5 mm out of its surface; what one look tells of a normal is no better.
    """
    cosine = (evidence.normals * evidence.measured_normals).sum(1)
    rows = (cosine.abs() > _SAME_SIDE).nonzero()[:, 0]
    normals, toward = evidence.normals[rows], cosine[rows].sign()[:, None] * evidence.measured_normals[rows]
    gain = (1.0 / (1.0 + model.observations[rows])).clamp_min(_LEAST_TURN)
    target = torch.nn.functional.normalize(normals + gain[:, None] * (toward - normals), dim=1)
    # The shortest rotation from one unit vector to another: (1 + cos, a x b), of half the angle once normalised.
    turn = torch.cat([1 + (normals * target).sum(1, keepdim=True), normals.cross(target, dim=1)], 1)
    turned = torch.from_numpy(quat_multiply(torch.nn.functional.normalize(turn, dim=1), model.quats[rows])).float()
    return replace(model, quats=model.quats.index_copy(0, rows, turned))


def update_visibility(model: GaussianModel, evidence: DepthComparison) -> GaussianModel:
    """The model with the evidence counted: what is seen through is doubted, and its opacity taken back by as much.

    A guess that is seen through was wrong, and one that is not :func:`stable` goes a look earlier.
    """
    limit = torch.where(stable(model), _GONE, _GONE_UNSTABLE)
    supported, through = evidence.supported, evidence.seen_through
    misses = torch.where(supported, (model.misses - 1).clamp_min(0), model.misses + through.int())
    logits = model.opacity_logits - _DOUBT * through.float()
    logits[(through & (model.observations == 0)) | (misses >= limit)] = -10.0
    return replace(model, observations=model.observations + supported.int(), misses=misses, opacity_logits=logits)


def stable(model: GaussianModel) -> Tensor:
    """Which Gaussians (N,) are well measured: supported thrice, the mean known to half the width of the disc."""
    width = model.log_scales.median(1).values.exp()
    return (model.observations >= _STABLE_LOOKS) & (model.uncertainty < _STABLE_WIDTH * width)


def initial_uncertainty(model: GaussianModel, T_world_camera: NDArray[np.float64], noise: DepthNoiseModel) -> Tensor:
    """σ (N,) [m] of Gaussians just made from a view: the sensor's, or a share of the depth where it was guessed."""
    T_camera_world = torch.from_numpy(inverse(T_world_camera)).float()
    z = model.means @ T_camera_world[2, :3] + T_camera_world[2, 3]
    return torch.where(model.observations > 0, noise(z), _GUESS * z)


def _rays(camera: Camera, points: Tensor) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Of points (N, 3) in the camera frame: ray (N, 3) of z = 1 through the nearest pixel; row; column; if inside."""
    z = points[:, 2].clamp_min(1e-6)
    u = torch.round(camera.fx * points[:, 0] / z + camera.cx)
    v = torch.round(camera.fy * points[:, 1] / z + camera.cy)
    inside = (points[:, 2] > 0.05) & (u >= 0) & (v >= 0) & (u < camera.width) & (v < camera.height)
    u, v = torch.where(inside, u, 0.0), torch.where(inside, v, 0.0)
    rays = torch.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, torch.ones_like(u)], 1)
    return rays, v.long(), u.long(), inside


def _nearest_around(depth: Tensor) -> Tensor:
    """The least depth (H, W) of each pixel's 3x3 neighbours: 0 where one of them is missing."""
    return torch.from_numpy(cv2.erode(depth.numpy(), np.ones((3, 3), np.uint8)))


def _of_all(count: int, rows: Tensor, values: Tensor, rest: float = 0.0) -> Tensor:
    """``values`` (M, ...) of the Gaussians that ``rows`` (M,) name, ``rest`` of the others: (count, ...)."""
    return values.new_full((count, *values.shape[1:]), rest).index_copy_(0, rows, values)

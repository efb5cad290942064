"""Cameras for the reference in plain torch: the oracle of ``cameras`` and its kernels, by other means than theirs.

A camera is a function of points; its derivative comes from autograd. The unscented transform sums the paper's weights
without rearrangement. The readout time of a rolling shutter is found by fixed-point iteration.
"""

from __future__ import annotations

from collections.abc import Callable

import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.rasterize.reference import Projector, ReferenceProjection, ReferenceView, reference_rotations
from splatbot.rasterize.scene import Gaussians

# Pixels (..., 2) of points (..., 3) of the camera frame; the intrinsics are (3, 3).
PointCamera = Callable[[Tensor, Tensor], Tensor]
# Line that a pixel (..., 2) is on and the number of lines, of an image of a width and height.
Lines = Callable[[Tensor, int, int], tuple[Tensor, int]]

_SHUTTER_ROUNDS = 25

LINES: dict[str, Lines] = {
    "ROLLING_TOP_TO_BOTTOM": lambda u, width, height: (u[..., 1] - 0.5, height),
    "ROLLING_LEFT_TO_RIGHT": lambda u, width, height: (u[..., 0] - 0.5, width),
    "ROLLING_BOTTOM_TO_TOP": lambda u, width, height: (height - 0.5 - u[..., 1], height),
    "ROLLING_RIGHT_TO_LEFT": lambda u, width, height: (width - 0.5 - u[..., 0], width),
}


def pinhole_points(points: Tensor, K: Tensor, coefficients: Tensor | None = None) -> Tensor:
    """Project by OpenCV's pinhole model; coefficients (12,): k1 .. k6, p1, p2, s1 .. s4."""
    x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    if coefficients is not None:
        k1, k2, k3, k4, k5, k6, p1, p2, s1, s2, s3, s4 = coefficients.unbind()
        r2 = x**2 + y**2
        c = (1 + k1 * r2 + k2 * r2**2 + k3 * r2**3) / (1 + k4 * r2 + k5 * r2**2 + k6 * r2**3)
        x, y = (
            x * c + 2 * p1 * x * y + p2 * (r2 + 2 * x**2) + s1 * r2 + s2 * r2**2,
            y * c + p1 * (r2 + 2 * y**2) + 2 * p2 * x * y + s3 * r2 + s4 * r2**2,
        )
    return _to_pixels(x, y, K)


def fisheye_points(points: Tensor, K: Tensor, coefficients: Tensor | None = None) -> Tensor:
    """Project by the equidistant model, or OpenCV's fisheye with coefficients (4,): k1 .. k4."""
    x, y, z = points.unbind(-1)
    r = (x**2 + y**2).clamp_min(1e-20).sqrt()
    angle = torch.atan2(r, z)
    bent = angle
    if coefficients is not None:
        bent = bent + sum(k * angle ** (2 * i + 3) for i, k in enumerate(coefficients.unbind()))
    return _to_pixels(x * bent / r, y * bent / r, K)


def ortho_points(points: Tensor, K: Tensor) -> Tensor:
    """Project along parallel rays."""
    return _to_pixels(points[..., 0], points[..., 1], K)


def affine_projector(camera: PointCamera) -> Projector:
    """Return the EWA projector: the covariance through the camera's derivative at the centre, J Σ Jᵀ."""

    def project(gaussians: Gaussians, view: ReferenceView, eps2d: float) -> ReferenceProjection:
        p = _to_camera(gaussians.means, view.viewmat)
        derivative = torch.func.vmap(torch.func.jacrev(lambda point: camera(point, view.K)))(p)
        J = derivative @ view.viewmat[:3, :3]
        covar2d = J @ _covariances(gaussians) @ J.mT
        return _projection(camera(p, view.K), covar2d, p[:, 2], eps2d)

    return project


def unscented_projector(
    camera: PointCamera,
    *,
    alpha: float = 0.1,
    beta: float = 2.0,
    kappa: float = 0.0,
    seen: Callable[[Tensor], Tensor] | None = None,
    shutter: str | None = None,
    last: Tensor | None = None,
) -> Projector:
    """Return the projector of the unscented transform (Wu et al. 2024, eq. 8 to 11).

    Args:
        camera: projects points.
        alpha, beta, kappa: spread of the sigma points.
        seen: whether points (..., 3) of the camera frame are in the lens's range; all are by default.
        shutter: one of ``LINES``, whose lines are read from the view's pose to ``last``, (4, 4).
    """

    def project(gaussians: Gaussians, view: ReferenceView, eps2d: float) -> ReferenceProjection:
        means, quats, scales = gaussians.means, gaussians.quats, gaussians.scales
        if quats is None or scales is None:
            raise InputError("are missing.", field="quats, scales", hint="the unscented transform needs the axes")
        spread = alpha**2 * (3 + kappa)
        axes = (reference_rotations(quats) * scales[:, None, :]).mT * spread**0.5  # (N, 3 axes, 3)
        points = torch.cat([means[:, None], means[:, None] + axes, means[:, None] - axes], 1)
        weights = torch.full((7,), 0.5 / spread, dtype=means.dtype)
        weights[0] = (spread - 3) / spread
        covar_weights = weights.clone()
        covar_weights[0] += 1 - alpha**2 + beta
        if shutter is None or last is None:
            middle = view.viewmat
            inside = _to_camera(points, view.viewmat)
            pixels = camera(inside, view.K)
        else:
            middle = _pose_between(view.viewmat, last, torch.tensor(0.5, dtype=means.dtype))
            pixels, inside = _read(points, camera, view, last, LINES[shutter])
        mean2d = (weights[:, None] * pixels).sum(1)
        d = pixels - mean2d[:, None]
        covar2d = torch.einsum("p,npi,npj->nij", covar_weights, d, d)
        depth = _to_camera(means, middle)[:, 2]
        if seen is not None:
            depth = torch.where(seen(inside).all(1), depth, -torch.ones_like(depth))
        return _projection(mean2d, covar2d, depth, eps2d)

    return project


def _covariances(gaussians: Gaussians) -> Tensor:
    """Return the covariances (N, 3, 3) [m²]; of given ones, the upper triangle counts."""
    quats, scales = gaussians.quats, gaussians.scales
    if gaussians.covars is not None:
        upper = gaussians.covars.triu()
        return upper + upper.triu(1).mT
    if quats is None or scales is None:
        raise InputError("are missing.", field="quats, scales", hint="give them, or covars")
    M = reference_rotations(quats) * scales[:, None, :]
    return M @ M.mT


def _projection(mean2d: Tensor, sharp2d: Tensor, depth: Tensor, eps2d: float) -> ReferenceProjection:
    covar2d = sharp2d + eps2d * torch.eye(2, dtype=mean2d.dtype)
    return ReferenceProjection(mean2d, sharp2d, covar2d, depth, torch.zeros_like(mean2d))


def _read(
    points: Tensor, camera: PointCamera, view: ReferenceView, last: Tensor, lines: Lines
) -> tuple[Tensor, Tensor]:
    """Project world points, each at the readout time of its line; return pixels and points in the camera frame."""
    time = torch.full(points.shape[:-1], 0.5, dtype=points.dtype)
    inside = points
    for _ in range(_SHUTTER_ROUNDS):
        poses = _pose_between(view.viewmat, last, time)
        inside = (poses[..., :3, :3] @ points[..., None])[..., 0] + poses[..., :3, 3]
        line, count = lines(camera(inside, view.K), view.width, view.height)
        time = (line / max(count - 1, 1)).clamp(0.0, 1.0) if count > 1 else torch.zeros_like(line)
    return camera(inside, view.K), inside


def _pose_between(first: Tensor, last: Tensor, time: Tensor) -> Tensor:
    """Interpolate poses (..., 4, 4) at times (...,) in 0..1 by a share of the rotation (Rodrigues)."""
    between = last[:3, :3] @ first[:3, :3].T
    angle = torch.arccos((0.5 * (between.diagonal().sum() - 1)).clamp(-1, 1))
    K = (between - between.T) / (2 * angle.sin() if float(angle.detach()) > 1e-9 else 1.0)
    a = (time * angle)[..., None, None]
    turned = (torch.eye(3, dtype=first.dtype) + a.sin() * K + (1 - a.cos()) * K @ K) @ first[:3, :3]
    moved = first[:3, 3] + time[..., None] * (last[:3, 3] - first[:3, 3])
    poses = torch.eye(4, dtype=first.dtype).expand(*time.shape, 4, 4).clone()
    poses[..., :3, :3] = turned
    poses[..., :3, 3] = moved
    return poses


def _to_camera(points: Tensor, viewmat: Tensor) -> Tensor:
    return points @ viewmat[:3, :3].T + viewmat[:3, 3]


def _to_pixels(x: Tensor, y: Tensor, K: Tensor) -> Tensor:
    return torch.stack([K[0, 0] * x + K[0, 2], K[1, 1] * y + K[1, 2]], -1)

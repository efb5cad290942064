"""Readout time of a rolling shutter and the constant error of depth, from features matched between frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.calibration.estimate import Estimate
from splatbot.calibration.motion import Pair, View, moved, updated, velocities
from splatbot.camera import Camera

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ReadoutConstants:
    """Constants of the estimation of the readout time and the bias of depth."""

    pixel_sigmas: tuple[float, ...] = (8.0, 4.0, 2.0, 1.0, 1.0, 1.0, 1.0, 1.0)
    """Standard deviation [px] of a feature of the finest level in each iteration. A large one in the beginning keeps
    the features that the readout displaces."""
    nu: float = 4.0
    """Degrees of freedom [1] of Student's t noise of features, as in tracking."""
    min_pairs: int = 12
    """Pairs of frames [1] below which their spread is no measure of the uncertainty."""
    readout_floor: float = 2e-4
    """Standard deviation [s] that more frames do not reduce, of the motion model within a frame."""
    bias_floor: float = 1e-3
    """Standard deviation [m] that more frames do not reduce, of the calibration of the lens."""
    largest_readout_sigma: float = 3e-3
    """Standard deviation [s] above which the readout time is refused: a tenth of that of a Kinect."""
    largest_bias_sigma: float = 5e-3
    """Standard deviation [m] above which the bias is refused."""
    largest_bias: float = 0.1
    """Bias [m] that no depth camera has. A larger one shows that something else distorts the images."""
    min_parallax: float = 0.05
    """Translation between two views over their distance to the scene [1], reached by a tenth of the pairs. Noise of
    the features replaces smaller parallax."""


CONSTANTS = ReadoutConstants()

_WEAK_INFORMATION = np.diag([1.0, 1e-2])  # the readout time is below 1 s, the bias below 10 m
_MIN_DEPTH = 0.05  # [m] of points in front of the camera


@dataclass(frozen=True)
class RowModel:
    """Result of the estimation.

    Args:
        readout: time from the first row to the last [s].
        bias: to be added to the measured depth [m].
        twists: velocities (6,) [m/s, rad/s] by index of the view.
    """

    readout: Estimate
    bias: Estimate
    twists: Mapping[int, Array]


def estimate_rows(views: Sequence[View], pairs: Sequence[Pair], camera: Camera) -> RowModel:
    """Estimate readout time and bias together with the poses of all pairs; the poses of ``pairs`` are updated.

    A feature j of the first view of a pair has the depth z_j, the row time s_j r and the ray a_j. In the second view
    its pixel is::

        π( exp(-s'_j r ξ') T exp(s_j r ξ) (z_j + b) a_j )

    The twists ξ and ξ' follow from the poses between neighbours. Gauss-Newton with weights of Student's t solves for
    r and b after the Schur complement of the pose T of each pair. The covariance is cluster-robust (Liang and Zeger
    1986), with the pairs of a first view as clusters. Only the difference of two velocities distorts a pair, so that a
    constant velocity does not determine r. Only the parallax of points at different depths determines b, as the scale
    of T is free.
    """
    p, shared = CONSTANTS, np.zeros(2)
    twists, clusters = velocities(views, pairs), dict[int, tuple[Array, Array]]()
    for sigma in p.pixel_sigmas:
        twists, clusters = velocities(views, pairs), {}
        usable = [pair for pair in pairs if pair.first in twists and pair.second in twists]
        systems = [_reduced(pair, twists, shared, camera, sigma) for pair in usable]
        for pair, system in zip(usable, systems, strict=True):
            H, g = clusters.get(pair.first, (np.zeros((2, 2)), np.zeros(2)))
            clusters[pair.first] = (H + system.H, g + system.g)
        A = sum((H for H, _ in clusters.values()), _WEAK_INFORMATION)
        gradient = sum((g for _, g in clusters.values()), np.zeros(2))
        step = np.asarray(-np.linalg.solve(A, gradient), dtype=np.float64)
        shared = np.asarray(shared + step, dtype=np.float64)
        for pair, system in zip(usable, systems, strict=True):
            pair.T_second_first = updated(pair.T_second_first, system.pose_step(step))
    sigmas = np.sqrt(np.diag(_sandwich(list(clusters.values()))) + np.array([p.readout_floor, p.bias_floor]) ** 2)
    if len(clusters) < p.min_pairs:
        sigmas = np.full(2, np.inf)
    if not _has_parallax(pairs) or abs(shared[1]) > p.largest_bias:
        sigmas[1] = np.inf
    (readout, bias), (readout_sigma, bias_sigma) = shared.tolist(), sigmas.tolist()
    to_and_fro, sideways = "turn the camera to and fro over texture", "move the camera sideways past near and far"
    return RowModel(
        Estimate.limited(readout, readout_sigma, "s", p.largest_readout_sigma, to_and_fro),
        Estimate.limited(bias, bias_sigma, "m", p.largest_bias_sigma, sideways),
        twists,
    )


def _has_parallax(pairs: Sequence[Pair]) -> bool:
    """Return whether the translation between pairs is large enough to measure depths by colour."""
    moved = [np.linalg.norm(pair.T_second_first[:3, 3]) / np.median(pair.points[:, 2]) for pair in pairs]
    return bool(moved) and float(np.percentile(moved, 90)) >= CONSTANTS.min_parallax


@dataclass(frozen=True, eq=False)
class _Reduced:
    """Normal equations H x = -g of readout time and bias from one pair, after the Schur complement of its pose."""

    H: Array
    g: Array
    H_pose: Array
    g_pose: Array
    H_pose_shared: Array

    def pose_step(self, shared_step: Array) -> Array:
        """Return the left increment (6,) of the pose that belongs to a step (2,) of readout time and bias."""
        return np.asarray(
            -np.linalg.solve(self.H_pose, self.g_pose + self.H_pose_shared @ shared_step), dtype=np.float64
        )


def _reduced(pair: Pair, twists: Mapping[int, Array], shared: Array, camera: Camera, pixel_sigma: float) -> _Reduced:
    """Compute the linearised reprojection residuals of a pair at its pose, the readout time and the bias."""
    readout, bias = shared
    xi, xi2, T, nu = twists[pair.first], twists[pair.second], pair.T_second_first, CONSTANTS.nu
    s = pair.pixels_first[:, 1] / (camera.height - 1) - 0.5
    s2 = pair.pixels[:, 1] / (camera.height - 1) - 0.5
    rays = pair.points / pair.points[:, 2:]
    X = moved(pair.points + bias * rays, s * readout, xi)
    q = X @ T[:3, :3].T + T[:3, 3]
    seen = moved(q, -s2 * readout, xi2)
    ahead = seen[:, 2] > _MIN_DEPTH
    seen = np.where(ahead[:, None], seen, [0.0, 0.0, 1.0])
    D = _projection_jacobian(seen, camera)
    r = camera.project(seen) - pair.pixels
    turned = s[:, None] * _velocity_of(X, xi) @ T[:3, :3].T - s2[:, None] * _velocity_of(q, xi2)
    J_pose = np.concatenate([D, -D @ _skews(q)], axis=2)
    J_shared = np.stack([_along(D, turned), _along(D, rays @ T[:3, :3].T)], axis=2)
    sigma2 = (pixel_sigma * pair.sigmas) ** 2
    w = np.where(ahead, (nu + 1) / (nu + (r**2).sum(1) / sigma2) / sigma2, 0.0)
    J = np.concatenate([J_pose, J_shared], axis=2)
    H, g = np.einsum("n,nki,nkj->ij", w, J, J), np.einsum("n,nki,nk->i", w, J, r)
    H_pose = H[:6, :6] + 1e-6 * np.eye(6)
    gain = np.linalg.solve(H_pose, H[:6, 6:]).T
    return _Reduced(H[6:, 6:] - gain @ H[:6, 6:], g[6:] - gain @ g[:6], H_pose, g[:6], H[:6, 6:])


def _projection_jacobian(points: Array, camera: Camera) -> Array:
    """Return dπ/dX (N, 2, 3) of points (N, 3)."""
    x, y, z = points.T
    zero = np.zeros_like(z)
    u = np.stack([camera.fx / z, zero, -camera.fx * x / z**2], axis=1)
    v = np.stack([zero, camera.fy / z, -camera.fy * y / z**2], axis=1)
    return np.stack([u, v], axis=1)


def _velocity_of(points: Array, twist: Array) -> Array:
    return np.asarray(twist[:3] + np.cross(twist[3:], points))


def _skews(points: Array) -> Array:
    """Return the cross-product matrices (N, 3, 3) of points (N, 3)."""
    x, y, z = points.T
    zero = np.zeros_like(z)
    return np.stack([zero, -z, y, z, zero, -x, -y, x, zero], axis=1).reshape(-1, 3, 3)


def _along(D: Array, directions: Array) -> Array:
    """Return the displacement (N, 2) [px] of points that move along directions (N, 3)."""
    return np.asarray(np.einsum("nij,nj->ni", D, directions))


def _sandwich(clusters: Sequence[tuple[Array, Array]]) -> Array:
    """Return the covariance (2, 2) from H and g of each cluster: cluster-robust, plus that of the noise model.

    The second term exceeds the first only where residuals determine little, as in a log at rest.
    """
    n = len(clusters)
    A = np.asarray(np.linalg.inv(sum((H for H, _ in clusters), _WEAK_INFORMATION)), dtype=np.float64)
    S = sum((np.outer(g, g) for _, g in clusters), np.zeros((2, 2)))
    return np.asarray(A @ S @ A * n / max(n - 2, 1) + A, dtype=np.float64)

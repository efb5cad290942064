"""Covisible keyframes: features matched between two keyframes, and the motion that explains them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.config import SensorConfig
from splatbot.geometry import inverse, se3_exp, transform_points
from splatbot.mapping.keyframes import Keyframe
from splatbot.tracking.features import Features, match_features, ransac_pose, spread
from splatbot.tracking.nearby_keyframes import order_by_distance, pose_distance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class CovisibilityConstants:
    """Constants of the search and of the noise of covisible pairs.

    Args:
        max_reprojection: [px] largest error of an inlier. It is twice that of tracking: a rolling shutter distorts two
            images differently, and the robust solution rejects what remains.
        min_inliers: matches below which a pair is not covisible.
        max_inliers: matches that a pair keeps, distributed over the image.
        max_translation, max_rotation: [m], [rad] keyframes farther apart see the place too differently to match.
        near: nearest keyframes that are always tried; the others are spread over the rest of the candidates.
        degrees_of_freedom: of Student's t distribution of a match's residuals.
        iterations: largest number of Gauss-Newton steps.
        converged: [m], [rad] step below which they end.
        pixel_sigma: [px] standard deviation of a keypoint on the finest level in one image.
        min_information: [1/m²], [1/rad²] information of any motion.
    """

    max_reprojection: float = 6.0
    min_inliers: int = 25
    max_inliers: int = 120
    max_translation: float = 1.0
    max_rotation: float = 0.6
    near: int = 4
    degrees_of_freedom: float = 4.0
    iterations: int = 6
    converged: float = 1e-5
    pixel_sigma: float = 1.0
    min_information: float = 1.0


CONSTANTS = CovisibilityConstants()


@dataclass(frozen=True, eq=False)
class CovisibleMatches:
    """Matched features of two keyframes; both features of a match have depth.

    Args:
        first, second: (M, 3) [m] points of the features, each in the camera frame of its keyframe.
        scales: (M,) the coarser of the two pyramid scales [px].
    """

    first: Array
    second: Array
    scales: Array


@dataclass(frozen=True, eq=False)
class RelativePose:
    """Motion between two keyframes that explains their matches best.

    Args:
        T_first_second: (4, 4).
        covariance: (6, 6) of the twist (t [m], ω [rad]) in the second camera's frame.
    """

    T_first_second: Array
    covariance: Array


def covisible_candidates(keyframe: Keyframe, others: Sequence[Keyframe], count: int) -> list[Keyframe]:
    """Return at most ``count`` keyframes that may see what ``keyframe`` sees, the nearest first.

    Half of them are the nearest. The rest are distributed over all keyframes in range, the oldest to the latest:
    pairs far apart in time hold a chain of keyframes together.
    """
    p = CONSTANTS
    order = [others[index] for index in order_by_distance(others, keyframe.T_world_camera)]
    inside = []
    for other in order:
        moved, turned = pose_distance(other.T_world_camera, keyframe.T_world_camera)
        if moved < p.max_translation and turned < p.max_rotation:
            inside.append(other)
    nearest, rest = inside[: min(p.near, count)], inside[p.near :]
    rest.sort(key=lambda other: other.number)
    more = min(count - len(nearest), len(rest))
    chosen = np.unique(np.linspace(0, len(rest) - 1, more).round().astype(int)) if more > 0 else ()
    return nearest + [rest[index] for index in chosen]


def match_keyframes(first: Keyframe, second: Keyframe, camera: Camera) -> CovisibleMatches | None:
    """Match the features of two keyframes; return None if too few agree with one motion (P3P in RANSAC).

    Args:
        camera: camera of the features' pixels.
    """
    p = CONSTANTS
    a, b = _with_depth(first.features), _with_depth(second.features)
    if min(len(a), len(b)) < p.min_inliers:
        return None
    of_b, of_a = match_features(b, a.descriptors)
    if len(of_a) < p.min_inliers:
        return None
    found = ransac_pose(a.points[of_a], b.pixels[of_b].astype(np.float64), camera, p.max_reprojection)
    if found is None or len(found[1]) < p.min_inliers:
        return None
    of_a, of_b = of_a[found[1]], of_b[found[1]]
    scales = np.maximum(a.scales[of_a], b.scales[of_b])
    known = np.ones(len(of_b), dtype=bool)
    keep = spread(b.pixels[of_b], 1.0 / scales.astype(np.float64), known, camera.width, p.max_inliers)
    return CovisibleMatches(a.points[of_a[keep]], b.points[of_b[keep]], scales[keep].astype(np.float64))


def relative_pose(
    matches: CovisibleMatches, T_first_second: Array, camera: Camera, sensor: SensorConfig
) -> RelativePose | None:
    """Estimate the motion between two keyframes from their matches, by Gauss-Newton from a first guess (4, 4).

    A match j has the point p_j in the first camera and p'_j in the second one, with the depths z_j and z'_j. The point
    moves to q_j = T_first_second⁻¹ p_j. The residuals are its reprojection and its depth::

        r_pixel,j = (π(q_j) - π(p'_j)) / (√2 s_j σ_px)
        r_depth,j = (q_j,z - z'_j) / (k √(σ_z(z_j)² + σ_z(z'_j)²))

    s_j is the pyramid scale of the match and k is ``sensor.depth_sigma_scale``: errors of calibration, and of depth
    that is measured later than color, are common to all matches. The weight of a match is that of Student's t
    distribution (Kerl et al. 2013). The covariance is the sandwich of the robust normal equations (Huber 1967).

    Returns:
        The motion, or None if it is not finite.
    """
    p = CONSTANTS
    T = T_first_second
    for _ in range(p.iterations):
        _, r, J = _residuals(matches, T, camera, sensor)
        w = (p.degrees_of_freedom + 3) / (p.degrees_of_freedom + (r**2).sum(axis=1))
        H = np.einsum("nki,nkj,n->ij", J, J, w, optimize=True) + p.min_information * np.eye(6)
        step = -np.linalg.solve(H, np.einsum("nki,nk,n->i", J, r, w, optimize=True))
        if not np.isfinite(step).all():
            return None
        T = T @ se3_exp(step)
        if np.abs(step).max() < p.converged:
            break
    _, r, J = _residuals(matches, T, camera, sensor)
    w = (p.degrees_of_freedom + 3) / (p.degrees_of_freedom + (r**2).sum(axis=1))
    H = np.einsum("nki,nkj,n->ij", J, J, w, optimize=True) + p.min_information * np.eye(6)
    gradients = np.einsum("nki,nk,n->ni", J, r, w, optimize=True)
    H_inverse = np.linalg.inv(H)
    covariance = H_inverse @ (gradients.T @ gradients) @ H_inverse + H_inverse * (6 / len(r))
    if not np.isfinite(T).all() or not np.isfinite(covariance).all():
        return None
    return RelativePose(T, 0.5 * (covariance + covariance.T))


def _residuals(
    matches: CovisibleMatches, T_first_second: Array, camera: Camera, sensor: SensorConfig
) -> tuple[Array, Array, Array]:
    """Return points in the second camera, residuals (M, 3) and their derivatives (M, 3, 6) by a right twist."""
    q = transform_points(inverse(T_first_second), matches.first)
    z = np.where(q[:, 2] > sensor.min_depth / 2, q[:, 2], np.nan)
    seen, depth = matches.second, matches.second[:, 2]
    pixel = np.sqrt(2.0) * CONSTANTS.pixel_sigma * matches.scales
    sigma_z = sensor.depth_sigma_scale * np.hypot(_sigma(matches.first[:, 2], sensor), _sigma(depth, sensor))
    r = np.stack(
        [
            camera.fx * (q[:, 0] / z - seen[:, 0] / depth) / pixel,
            camera.fy * (q[:, 1] / z - seen[:, 1] / depth) / pixel,
            (z - depth) / sigma_z,
        ],
        axis=1,
    )
    zero = np.zeros_like(z)
    of_point = np.stack(
        [
            np.stack([camera.fx / z / pixel, zero, -camera.fx * q[:, 0] / z**2 / pixel], axis=1),
            np.stack([zero, camera.fy / z / pixel, -camera.fy * q[:, 1] / z**2 / pixel], axis=1),
            np.stack([zero, zero, 1 / sigma_z], axis=1),
        ],
        axis=1,
    )
    # q moves by -(v + ω x q) for the twist (v, ω); the rows of `of_point` contract with ω x q as q x row.
    J = np.concatenate([-of_point, -np.cross(q[:, None, :], of_point)], axis=2)
    ahead = np.isfinite(z)
    return q, np.where(ahead[:, None], r, 0.0), np.where(ahead[:, None, None], J, 0.0)


def _sigma(depth: Array, sensor: SensorConfig) -> Array:
    return sensor.sigma_depth_floor + sensor.sigma_depth_quad * depth**2


def _with_depth(features: Features) -> Features:
    known = np.flatnonzero(np.isfinite(features.points[:, 2]) & (features.points[:, 2] > 0))
    return Features(features.pixels[known], features.descriptors[known], features.points[known], features.scales[known])

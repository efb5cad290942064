"""The Gaussians that training starts from."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse
from splatbot.training.datasets import TrainingData
from splatbot.training.images import ImageCache

Array = NDArray[np.float64]


@dataclass(frozen=True)
class InitialConstants:
    """Constants of the initial Gaussians.

    Args:
        neighbours: number of nearest points; a Gaussian's σ is the root mean square distance to them.
        opacity: of each Gaussian.
        random_points: number of points if a dataset has none.
        draws: points that are drawn for each that is kept; an object may fill a small part of the cube.
        half_size: half the side of their cube [share of the cameras' mean distance from the point they look at].
        seen_share: share of the cameras that must see a random point.
        least_alpha: smaller alpha in an image shows that a point is empty space.
    """

    neighbours: int = 3
    opacity: float = 0.1
    random_points: int = 50_000
    draws: int = 10
    half_size: float = 0.5
    seen_share: float = 0.25
    least_alpha: float = 0.02


CONSTANTS = InitialConstants()


def initial_model(
    data: TrainingData, images: ImageCache, *, most: int, seed: int, surfels: bool = False
) -> GaussianModel:
    """Return Gaussians at the points of a dataset, or at random points where it has none.

    Args:
        data: the dataset.
        images: of its training views.
        most: largest number of Gaussians; more points are thinned at random.
        seed: of the random draws.
        surfels: return discs of random directions.
    """
    random = np.random.default_rng(seed)
    points, colors = data.points, data.point_colors.astype(np.float64) / 255
    if not len(points):
        points = random_points(images, min(most, CONSTANTS.random_points), random)
        colors = random.uniform(0.0, 1.0, points.shape)
    if len(points) > most:
        kept = np.sort(random.choice(len(points), most, replace=False))
        points, colors = points[kept], colors[kept]
    quats = np.tile([1.0, 0.0, 0.0, 0.0], (len(points), 1))
    scales = np.repeat(neighbour_distances(points)[:, None], 3, axis=1)
    if surfels:
        quats, scales = random.normal(size=quats.shape), scales * [1.0, 1.0, 0.0]
    return GaussianModel.from_activated(
        means=points,
        quats=quats,
        scales=scales,
        opacities=np.full(len(points), CONSTANTS.opacity),
        colors=colors,
    )


def neighbour_distances(points: Array) -> Array:
    """Return the root mean square distance (M,) [m] of each point to its three nearest neighbours, at least 1e-6."""
    k = min(CONSTANTS.neighbours, len(points) - 1)
    if k < 1:
        return np.full(len(points), 0.01)
    distances = cKDTree(points).query(points, k + 1)[0][:, 1:]
    return np.maximum(np.sqrt((distances**2).mean(axis=1)), 1e-6)


def random_points(images: ImageCache, count: int, random: np.random.Generator) -> Array:
    """Return points (M, 3), uniform in the cube around the point that the cameras look at.

    More points are drawn than ``count``. Kept are those that a quarter of the cameras see and that no image with alpha
    shows as empty space, the visual hull.
    """
    poses = np.stack([view.T_world_camera for view in images.views])
    center = looked_at(poses)
    half = CONSTANTS.half_size * float(np.linalg.norm(poses[:, :3, 3] - center, axis=1).mean())
    drawn = random.uniform(-half, half, (CONSTANTS.draws * count, 3)) + center
    kept = _in_visual_hull(images, drawn)
    return kept[:count] if len(kept) else drawn[:count]


def looked_at(poses: Array) -> Array:
    """Return the point (3,) nearest to all optical axes, by least squares.

    p = (Σ P_i)⁻¹ Σ P_i c_i with P_i = I - a_i a_iᵀ, axes a_i and centres c_i. Parallel axes leave it undetermined; the
    mean of the centres is the prior.

    Args:
        poses: (C, 4, 4), T_world_camera.
    """
    axes, centers = poses[:, :3, 2], poses[:, :3, 3]
    across = np.eye(3) - axes[:, :, None] * axes[:, None, :]
    prior = 1e-3 * len(poses)
    return np.asarray(
        np.linalg.solve(
            across.sum(axis=0) + prior * np.eye(3),
            (across @ centers[:, :, None]).sum(axis=0)[:, 0] + prior * centers.mean(axis=0),
        )
    )


def _in_visual_hull(images: ImageCache, points: Array) -> Array:
    """Return those of the points that enough cameras see and that no image with alpha shows as empty space."""
    views = np.zeros(len(points))
    for index, view in enumerate(images.views):
        photo = images.photo(index, 4)
        T_camera_world = inverse(view.T_world_camera)
        p = points @ T_camera_world[:3, :3].T + T_camera_world[:3, 3]
        front = p[:, 2] > 1e-6
        u, v = photo.camera.project(np.where(front[:, None], p, [0.0, 0.0, 1.0])).round().astype(int).T
        seen = front & (u >= 0) & (v >= 0) & (u < photo.camera.width) & (v < photo.camera.height)
        views += seen
        if photo.alpha is not None:
            empty = np.zeros(len(points), dtype=bool)
            empty[seen] = photo.alpha.numpy()[v[seen], u[seen]] < CONSTANTS.least_alpha
            points, views = points[~empty], views[~empty]
    return points[views >= CONSTANTS.seen_share * len(images.views)]

"""Generalized ICP registration of point clouds (Segal, Haehnel and Thrun, RSS 2009) by small_gicp."""

from __future__ import annotations

from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
import small_gicp
from numpy.typing import NDArray

from splatbot.geometry import inverse
from splatbot.tracking.features import Features
from splatbot.tracking.nearby_keyframes import TrackedKeyframe
from splatbot.tracking.prepare import Level, PreparedFrame

Array = NDArray[np.float64]
Cloud = tuple[small_gicp.PointCloud, small_gicp.KdTree]


@dataclass(frozen=True)
class GicpConstants:
    """Empirical constants of the registration."""

    neighbors: int = 10
    """Number of neighbours [1] for the covariance of a point. More of them smooth thin structures away."""
    max_distances: tuple[float, ...] = (0.3, 0.05)
    """Largest distance [m] between corresponding points in each round. Without it, distant pairs bias the pose."""
    max_iterations: int = 20
    """Largest number of iterations [1] per round."""
    min_inliers: float = 0.3
    """Share of points [1] with a correspondence below which the clouds do not overlap."""


CONSTANTS = GicpConstants()


class GicpRegistration:
    """Registers frames with keyframes in one thread, and caches the clouds of the keyframes."""

    def __init__(self) -> None:
        self._clouds: WeakKeyDictionary[Features, Cloud] = WeakKeyDictionary()

    def register(
        self, prepared: PreparedFrame, keyframe: TrackedKeyframe, T_world_camera: Array, n_points: int
    ) -> Array | None:
        """Register a frame with a keyframe, and return T_world_camera (4, 4).

        G-ICP minimises Σ dᵢᵀ (Cᵢᵗ + R Cᵢˢ Rᵀ)⁻¹ dᵢ with dᵢ = qᵢ - T pᵢ over the pairs of points and their covariances.
        The solver also reports convergence for wrong poses, so the result is a hypothesis that must be scored.

        Args:
            prepared: the frame.
            keyframe: keyframe to register with.
            T_world_camera: (4, 4) initial pose.
            n_points: approximate number of points of the frame.

        Returns:
            The pose, or None if too few points have a correspondence.
        """
        source, target = cloud_of(points_of(prepared, n_points)), self._keyframe_cloud(keyframe)
        if source is None or target is None:
            return None
        T_world_keyframe = keyframe.reference.T_world_camera
        T = inverse(T_world_keyframe) @ T_world_camera
        for max_distance in CONSTANTS.max_distances:
            found = small_gicp.align(
                target[0],
                source[0],
                target[1],
                init_T_target_source=T,
                registration_type="GICP",
                max_correspondence_distance=max_distance,
                num_threads=1,
                max_iterations=CONSTANTS.max_iterations,
            )
            T = np.asarray(found.T_target_source, dtype=np.float64)
        overlaps = found.num_inliers >= CONSTANTS.min_inliers * source[0].size()
        return T_world_keyframe @ T if overlaps and np.isfinite(T).all() else None

    def _keyframe_cloud(self, keyframe: TrackedKeyframe) -> Cloud | None:
        known = self._clouds.get(keyframe.features)
        if known is None:
            level = keyframe.reference.levels[min(1, len(keyframe.reference.levels) - 1)]
            known = cloud_of(level.points.astype(np.float64))
            if known is not None:
                self._clouds[keyframe.features] = known
        return known


def points_of(prepared: PreparedFrame, n: int) -> Array:
    """Sample about n points (N, 3) [m] in the camera's frame, on a regular grid of the second finest level."""
    level: Level = prepared.levels[min(1, len(prepared.levels) - 1)]
    stride = max(1, round(float(np.sqrt((level.depth > 0).sum() / n))))
    points = level.camera.backproject(level.depth)[::stride, ::stride][level.depth[::stride, ::stride] > 0]
    return points.astype(np.float64)


def cloud_of(points: Array) -> Cloud | None:
    """Build a point cloud with covariances and a search tree from points (N, 3) [m].

    Return None if there are too few points for a covariance.
    """
    if len(points) <= CONSTANTS.neighbors:
        return None
    cloud = small_gicp.PointCloud(points)
    tree = small_gicp.KdTree(cloud, num_threads=1)
    small_gicp.estimate_covariances(cloud, tree, num_neighbors=CONSTANTS.neighbors, num_threads=1)
    return cloud, tree

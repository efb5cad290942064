"""Registration of point clouds (G-ICP, Segal et al. 2009): the widest basin, for where features find nothing."""

from __future__ import annotations

from weakref import WeakKeyDictionary

import numpy as np
import small_gicp
from numpy.typing import NDArray

from splatbot.config import TrackingConfig
from splatbot.geometry import inverse
from splatbot.tracking.features import Features
from splatbot.tracking.nearby_keyframes import TrackedKeyframe
from splatbot.tracking.prepare import Level, PreparedFrame

Array = NDArray[np.float64]
Cloud = tuple[small_gicp.PointCloud, small_gicp.KdTree]

_NEIGHBOURS = 10  # that a point's covariance is made of
# Pairs farther apart, first and then, are none: unbounded, the search is slow and the far pairs pull.
_REACH = (0.3, 0.05)  # [m]
_MOST_STEPS = 20
_LEAST_PAIRS = 0.3  # of the points; with fewer there is no overlap to speak of


class GicpStage:
    """Registers frames with keyframes, one thread; remembers the keyframes' clouds."""

    def __init__(self, config: TrackingConfig) -> None:
        self.config = config
        self._clouds: WeakKeyDictionary[Features, Cloud] = WeakKeyDictionary()

    def __getstate__(self) -> dict[str, object]:
        """Without the clouds, which are made again from the keyframes."""
        return {"config": self.config, "_clouds": WeakKeyDictionary()}

    def register(self, prepared: PreparedFrame, view: TrackedKeyframe, T_world_camera: Array) -> Array | None:
        """T_world_camera (4, 4) from a start; None where too few points find a partner.

        What it returns is a proposal: the solver calls wrong results converged, so that the health check has to judge.
        """
        frame = cloud_of(points_of(prepared, self.config.gicp_points))
        keyframe = self._keyframe_cloud(view)
        if frame is None or keyframe is None:
            return None
        T_world_keyframe = view.reference.T_world_camera
        T = inverse(T_world_keyframe) @ T_world_camera
        for reach in _REACH:
            found = small_gicp.align(
                keyframe[0],
                frame[0],
                keyframe[1],
                init_T_target_source=T,
                registration_type="GICP",
                max_correspondence_distance=reach,
                num_threads=1,
                max_iterations=_MOST_STEPS,
            )
            T = np.asarray(found.T_target_source, dtype=np.float64)
        enough = found.num_inliers >= _LEAST_PAIRS * frame[0].size()
        return T_world_keyframe @ T if enough and np.isfinite(T).all() else None

    def _keyframe_cloud(self, view: TrackedKeyframe) -> Cloud | None:
        known = self._clouds.get(view.features)
        if known is None:
            level = view.reference.levels[min(1, len(view.reference.levels) - 1)]
            known = cloud_of(level.points.astype(np.float64))
            if known is not None:
                self._clouds[view.features] = known
        return known


def points_of(prepared: PreparedFrame, n: int) -> Array:
    """About n points (N, 3) [m] of a frame, on a regular grid of its second finest level, in the camera's frame."""
    level: Level = prepared.levels[min(1, len(prepared.levels) - 1)]
    stride = max(1, round(float(np.sqrt((level.depth > 0).sum() / n))))
    points = level.camera.backproject(level.depth)[::stride, ::stride][level.depth[::stride, ::stride] > 0]
    return points.astype(np.float64)


def cloud_of(points: Array) -> Cloud | None:
    """Points (N, 3) [m] with their covariances and a search tree; None of fewer than make a covariance."""
    if len(points) <= _NEIGHBOURS:
        return None
    cloud = small_gicp.PointCloud(points)
    tree = small_gicp.KdTree(cloud, num_threads=1)
    small_gicp.estimate_covariances(cloud, tree, num_neighbors=_NEIGHBOURS, num_threads=1)
    return cloud, tree

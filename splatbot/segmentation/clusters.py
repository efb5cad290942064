"""Euclidean clustering of points."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.protocols import Array


@dataclass(frozen=True)
class ClusterConstants:
    """Constants of clusters of points.

    Args:
        max_distance: [m] maximum distance between neighbouring points of one cluster.
        min_core_neighbours: neighbours of a core point.
    """

    max_distance: float = 0.025
    min_core_neighbours: int = 5


CONSTANTS = ClusterConstants()


def clusters(points: Array, *, apart: float = CONSTANTS.max_distance) -> list[NDArray[np.int64]]:
    """Cluster points (P, 3) [m] by DBSCAN (Ester et al. 1996); return the rows of each cluster, largest first.

    Noise points are in no cluster.
    """
    import open3d as o3d

    if not len(points):
        return []
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    label = np.asarray(cloud.cluster_dbscan(eps=apart, min_points=CONSTANTS.min_core_neighbours))
    found = [np.flatnonzero(label == k) for k in range(int(label.max()) + 1)]
    return sorted(found, key=lambda rows: (-len(rows), int(rows[0])))

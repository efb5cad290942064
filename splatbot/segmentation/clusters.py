"""Euclidean clustering of points."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.protocols import Array

CLUSTER_DISTANCE_M = 0.025  # maximum distance between neighbouring points of one cluster
_MIN_CORE_NEIGHBOURS = 5  # of a core point


def clusters(points: Array, *, apart: float = CLUSTER_DISTANCE_M) -> list[NDArray[np.int64]]:
    """Cluster points (P, 3) [m] by DBSCAN (Ester et al. 1996); return the rows of each cluster, largest first.

    Noise points are in no cluster.
    """
    import open3d as o3d

    if not len(points):
        return []
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    label = np.asarray(cloud.cluster_dbscan(eps=apart, min_points=_MIN_CORE_NEIGHBOURS))
    found = [np.flatnonzero(label == k) for k in range(int(label.max()) + 1)]
    return sorted(found, key=lambda rows: (-len(rows), int(rows[0])))

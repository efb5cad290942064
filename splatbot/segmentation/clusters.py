"""Points that hang together."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.protocols import Array

TOGETHER = 0.025  # [m] between points of one object
_CORE = 5  # neighbours of a point that is no noise


def clusters(points: Array, *, apart: float = TOGETHER) -> list[NDArray[np.int64]]:
    """Rows of points (P, 3) [m] that hang together, largest first (DBSCAN; Ester et al. 1996); noise is in none."""
    import open3d as o3d

    if not len(points):
        return []
    cloud = o3d.geometry.PointCloud(o3d.utility.Vector3dVector(points))
    label = np.asarray(cloud.cluster_dbscan(eps=apart, min_points=_CORE))
    found = [np.flatnonzero(label == k) for k in range(int(label.max()) + 1)]
    return sorted(found, key=lambda rows: (-len(rows), int(rows[0])))

"""The map as nvblox' dense distance field (nvblox_msgs/EsdfAndGradients), the world that Isaac ROS' cuMotion reads."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.collision.esdf import esdf
from splatbot.errors import InputError
from splatbot.logs.ros_frames import header
from splatbot.logs.ros_types import to_plain
from splatbot.services.problems import TooLargeError
from splatbot.services.ros.graph import RosGraph, Service
from splatbot.services.ros.messages import MAP_FRAME
from splatbot.services.ros.moveit import main_map
from splatbot.services.ros.requests import entry, number, vector
from splatbot.services.store import MapStore

ESDF_SERVICE = "/nvblox_node/get_esdf_and_gradient"
_VOXEL = 0.05  # [m], nvblox' own default
_CUT = 2.0  # [m], as nvblox' max_distance
_MOST_VOXELS = 2_000_000  # of one answer: 8 MB of distances, and 24 of gradients


class NvbloxServices:
    """EsdfAndGradients on the main map of a store.

    ``esdf_and_gradients`` holds the distances [m] with dimensions x, y, z, as cuMotion reads them. ``gradients``, an
    addition to nvblox' message, holds the unit gradients with a fourth dimension. Requests may add ``voxel_size_m``.

    Args:
        graph: registers the service.
        store: the maps.
    """

    def __init__(self, graph: RosGraph, store: MapStore) -> None:
        self._store = store
        graph.serve(ESDF_SERVICE, Service("nvblox_msgs/srv/EsdfAndGradients", self.esdf))

    def esdf(self, args: Mapping[str, Any]) -> dict[str, Any]:
        """Sample the distance field in the request's box, or in the box around all Gaussians.

        Raises:
            SplatbotError: the box is empty or too large, the frame is not the map's, or there is no map.
        """
        served = main_map(self._store)
        frame = entry(args, "frame_id") or MAP_FRAME
        if frame not in (MAP_FRAME, "world", "odom"):
            raise InputError(f"is {str(frame)[:40]!r}.", field="frame_id", hint=f"use {MAP_FRAME}")
        voxel = number(args, "voxel_size_m") or _VOXEL
        if entry(args, "use_aabb"):
            low = vector(args, "aabb_min_m")
            high = low + vector(args, "aabb_size_m")
        else:
            means = served.ready.model.means.numpy()
            low, high = (means.min(0) - voxel, means.max(0) + voxel) if len(means) else (np.zeros(3), np.full(3, voxel))
        if voxel <= 0 or not (high > low).all():
            raise InputError(f"is empty, or the voxels of {voxel} m are.", field="aabb_size_m", hint="give lengths > 0")
        voxels = float(np.prod(np.ceil((high - low) / voxel)))
        if not voxels <= _MOST_VOXELS:
            hint = f"at most {_MOST_VOXELS} voxels are answered: ask for a smaller box or larger voxels"
            raise TooLargeError(f"needs {voxels:.3g} voxels of {voxel:g} m.", field="aabb_size_m", hint=hint)
        grid = esdf(served.field, np.stack([low, high]), voxel, cut=_CUT)
        return {
            "header": to_plain(header(served.ready.stamp, MAP_FRAME)),
            "origin_m": dict(zip("xyz", low.tolist(), strict=True)),
            "voxel_size_m": voxel,
            "esdf_and_gradients": _multi_array(grid.distance, "xyz"),
            "gradients": _multi_array(grid.gradient, "xyzv"),
            "success": True,
        }


def _multi_array(values: NDArray[np.float32], labels: str) -> dict[str, Any]:
    """Build a std_msgs/Float32MultiArray, row by row."""
    strides = [int(np.prod(values.shape[i:])) for i in range(values.ndim)]
    sizes = zip(labels, values.shape, strides, strict=True)
    dim = [{"label": label, "size": size, "stride": stride} for label, size, stride in sizes]
    return {"layout": {"dim": dim, "data_offset": 0}, "data": values.ravel()}

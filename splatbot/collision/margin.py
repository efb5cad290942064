"""Distance between the surfaces of a map and its own depth images, and the margin that follows from it."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.camera import Camera
from splatbot.collision.field import GaussianCollisionField
from splatbot.collision.inputs import rows
from splatbot.errors import InputError
from splatbot.geometry import transform_points
from splatbot.protocols import Array


@dataclass(frozen=True)
class MarginConstants:
    """Constants of the measured surface error.

    Args:
        points_per_view: largest number of pixels of one view.
        max_error: [m] larger distances between a measured point and the map are clamped.
    """

    points_per_view: int = 5000
    max_error: float = 0.3


CONSTANTS = MarginConstants()


@dataclass(frozen=True, eq=False)
class SurfaceError:
    """Distances of measured surface points from the ellipsoids of a field.

    A sphere that contains a surface point at depth d collides with the field if the error of that point is below d.
    Therefore no sphere that the field reports as free penetrates a surface deeper than the error there.

    Args:
        sorted: (P,) errors in ascending order [m]; 0 for points inside an ellipsoid.
    """

    sorted: Array

    def share(self, share: float) -> float:
        """Return the quantile of the error [m]: a fraction ``share`` (0..1) of the points does not exceed it."""
        if not 0.0 <= share <= 1.0:
            raise InputError(f"is {share}.", field="share", hint="give a value in 0..1, as 0.999")
        return float(np.quantile(self.sorted, share))


def surface_error(
    field: GaussianCollisionField,
    views: Iterable[tuple[NDArray[np.float32], Camera, Array]],
    *,
    around: ArrayLike | None = None,
) -> SurfaceError:
    """Measure the distance of up to 5,000 evenly spaced pixels of each view from the field.

    ``surface_error(field, views).share(0.999)`` is a suitable ``margin`` of :class:`RobotSpheres` to avoid contact in
    observed space. It contains the noise of the depth images and is therefore slightly too large.

    Args:
        field: collision field.
        views: depth (H, W) [m], 0 or NaN where invalid, camera, and tracked T_world_camera (4, 4) of each view.
        around: (x, y, z, radius) of a sphere that limits the points, as the reach of an arm [m, world]. If None, all
            points count.

    Raises:
        InputError: the size of a depth image differs from its camera's, or no view has depth in the sphere.
    """
    ball = None if around is None else rows(np.atleast_2d(np.asarray(around)), "around", 4, "(x, y, z, radius)")[0]
    found = []
    for depth, camera, T_world_camera in views:
        if depth.shape != (camera.height, camera.width):
            raise InputError(f"is {depth.shape}.", field="depth", hint=f"give ({camera.height}, {camera.width})")
        v, u = np.nonzero(np.isfinite(depth) & (depth > 0))
        some = np.linspace(0, len(v) - 1, min(len(v), CONSTANTS.points_per_view)).astype(np.int64)
        z = depth[v[some], u[some]].astype(np.float64)
        ray = np.stack([(u[some] - camera.cx) / camera.fx, (v[some] - camera.cy) / camera.fy, np.ones(len(some))], 1)
        points = transform_points(T_world_camera, ray * z[:, None])
        if ball is not None:
            points = points[np.linalg.norm(points - ball[:3], axis=1) <= ball[3]]
        found.append(np.clip(field.clearance(points, cut=CONSTANTS.max_error).distance, 0.0, CONSTANTS.max_error))
    if not sum(map(len, found)):
        raise InputError("have no depth.", field="views", hint="give the depth images that the map was made of")
    return SurfaceError(np.sort(np.concatenate(found)))

"""Measured surface that the map of a run lacks, as spheres that plans avoid."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.collision.confirmed import confirmed_near
from splatbot.logs import Log
from splatbot.protocols import Array
from splatbot.results.folder import RunFolder
from splatbot.results.margin import CONSTANTS as MARGIN
from splatbot.results.views import raw_views


@dataclass(frozen=True)
class MeasuredSurfaceConstants:
    """Constants of the measured surface.

    Args:
        spacing: [m] edge of the voxels in which each frame proposes at most one point.
        voxel: [m] edge of the voxels whose points one sphere encloses. A larger one makes fewer, larger spheres.
        most: largest number of proposed points; it bounds the work.
        least_radius: [m] of a sphere, as of one point.
    """

    spacing: float = 0.003
    voxel: float = 0.004
    most: int = 2_000_000
    least_radius: float = 0.0005


CONSTANTS = MeasuredSurfaceConstants()


def surface_outside(run: RunFolder, log: Log, field: GaussianCollisionField, arm: RobotSpheres) -> Array:
    """Find measured surface outside of the ellipsoids of a run's map, and enclose its points in spheres.

    All pixels with depth of at most 40 evenly spaced frames count. A second frame must measure the same depth there,
    and at most a tenth of the frames may see through the point (:func:`splatbot.collision.confirmed.confirmed_near`).

    Args:
        run: folder of the run.
        log: the log of the run, with the same masks.
        field: collision field of the run's map.
        arm: the arm; points in its reach count.

    Returns:
        (M, 4) centers [m, world] and radii [m].

    Raises:
        FormatError: the folder is damaged.
        LogError: the log is damaged.
    """
    sensor, center, reach = run.load_config().sensor, arm.T_world_base[:3, 3], arm.reach_radius

    def outside(points: Array) -> NDArray[np.bool_]:
        near = np.asarray(np.linalg.norm(points - center, axis=1) < reach)
        near[near] = ~field.in_collision(points[near])
        return near

    points = confirmed_near(
        raw_views(run, log)[1],
        center - reach,
        center + reach,
        floor=sensor.sigma_depth_floor,
        quad=sensor.sigma_depth_quad,
        spacing=CONSTANTS.spacing,
        most=CONSTANTS.most,
        agreeing_views=MARGIN.agreeing_views,
        inside=outside,
    )
    return enclosing_spheres(points, CONSTANTS.voxel, CONSTANTS.least_radius)


def enclosing_spheres(points: Array, voxel: float, least_radius: float) -> Array:
    """Return one sphere (M, 4) for each voxel with points: their mean [m], and the distance of the farthest [m].

    Args:
        points: (P, 3) [m].
        voxel: edge of the voxels [m].
        least_radius: least radius of a sphere [m].
    """
    cells = np.floor(points / voxel).astype(np.int64)
    _, first, of_point, count = np.unique(cells, axis=0, return_index=True, return_inverse=True, return_counts=True)
    of_point = of_point.ravel()
    mean = np.stack([np.bincount(of_point, points[:, i], len(first)) for i in range(3)], axis=1) / count[:, None]
    radius = np.full(len(first), least_radius)
    np.maximum.at(radius, of_point, np.linalg.norm(points - mean[of_point], axis=1))
    return np.c_[mean, radius]

"""Collision margin of a run's map from confirmed depth, for the region in which a robot moves."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial import cKDTree

from splatbot.collision import GaussianCollisionField
from splatbot.collision.audit import audit_surfaces
from splatbot.collision.confirmed import find_confirmed
from splatbot.errors import InputError
from splatbot.logs import Log
from splatbot.protocols import Array
from splatbot.results.folder import RunFolder
from splatbot.results.views import raw_views


@dataclass(frozen=True)
class RunMarginConstants:
    """Constants of the recommended margin."""

    radius: float = 1.0
    """Distance [m] around the base in which points count. A larger one includes distant surfaces, whose error is
    larger."""
    confidence: float = 0.999
    """Quantile [1] of the surface error that the margin covers. A larger one gives a larger margin, which outliers
    determine."""
    agreeing_views: int = 1
    """Number of other frames [1] that confirm a surface point. The audit requires two; a margin must also cover surface
    that only two frames saw."""
    region: float = 0.2
    """Distance [m] of the arm's sphere centers, or of a target, within which points belong to the region of a motion. A
    larger one averages over more surface."""
    cell: float = 0.02
    """Edge [m] of the cells of which one center each bounds the distances, before the exact search among few points."""


CONSTANTS = RunMarginConstants()


def least_points(confidence: float) -> int:
    """Return the number of points of which one may exceed a quantile ``confidence`` (0..1) of their errors."""
    return int(np.ceil(1.0 / max(1.0 - confidence, 1e-12)))


@dataclass(frozen=True, eq=False)
class AuditedError:
    """Distances of confirmed surface points from the ellipsoids of a map.

    Args:
        points: (S, 3) confirmed surface points [m, world].
        error: (S,) distance of each from the nearest ellipsoid [m], 0 inside one.
    """

    points: Array
    error: Array

    def __len__(self) -> int:
        """Return the number of points."""
        return len(self.error)

    def near(self, centers: ArrayLike, distance: float, least: int = 0) -> AuditedError:
        """Return the points within ``distance`` [m] of any of the ``centers`` (C, 3) [m, world].

        If fewer than ``least`` points are there, the nearest ``least`` points are returned.
        """
        all_centers = np.asarray(centers, dtype=np.float64).reshape(-1, 3)
        least = min(least, len(self.points))
        # One centre of each cell bounds the distance: not below it, and above it by at most the cell's diagonal.
        cell = CONSTANTS.cell
        cells = np.floor(all_centers / cell).astype(np.int64) @ [1, 1 << 20, 1 << 40]
        some = all_centers[np.unique(cells, return_index=True)[1]]
        most = cKDTree(some).query(self.points)[0]
        reach = max(distance, float(np.partition(most, least - 1)[least - 1]) if least else 0.0)
        near = np.flatnonzero(most <= reach + np.sqrt(3.0) * cell)
        gap = cKDTree(all_centers).query(self.points[near], distance_upper_bound=np.nextafter(reach, np.inf))[0]
        few = np.count_nonzero(gap <= distance) < least
        chosen = near[gap <= (np.partition(gap, least - 1)[least - 1] if few else distance)]
        return AuditedError(self.points[chosen], self.error[chosen])

    def in_region(self, centers: ArrayLike, confidence: float = CONSTANTS.confidence) -> AuditedError:
        """Return the points near the ``centers`` (C, 3) [m, world], at least as many as the confidence (0..1) needs."""
        return self.near(centers, CONSTANTS.region, min(len(self), least_points(confidence)))

    def quantile(self, confidence: float) -> float:
        """Return an error [m] that a fraction ``confidence`` (0..1) of the points does not exceed; 0 without points.

        It is the error of a point, not an interpolation, so that few points give their largest error.

        Raises:
            InputError: the confidence is not in 0..1.
        """
        if not 0.0 <= confidence <= 1.0:
            raise InputError(f"is {confidence}.", field="confidence", hint="give a value in 0..1, as 0.999")
        return float(np.quantile(self.error, confidence, method="higher")) if len(self.error) else 0.0


def audited_error(run: str | Path, log: Log, field: GaussianCollisionField) -> AuditedError:
    """Measure the distance of a run's confirmed surface points from a field of its map.

    Args:
        run: folder of the run.
        log: the log of the run, with the same masks.
        field: collision field of the run's map.

    Raises:
        FormatError: the folder is damaged.
        LogError: the log is damaged.
        InputError: no surface point is confirmed, as in a run of a single frame.
    """
    folder = RunFolder(run)
    sensor = folder.load_config().sensor
    _, views = raw_views(folder, log)
    space = find_confirmed(
        views,
        floor=sensor.sigma_depth_floor,
        quad=sensor.sigma_depth_quad,
        agreeing_views=CONSTANTS.agreeing_views,
    )
    audit = audit_surfaces(field, space)
    if not len(audit.distance):
        raise InputError(
            "has no surface point that two frames measured.",
            file=run,
            field="margin",
            hint="give the margin in metres",
        )
    return AuditedError(audit.space.surface, audit.distance)


def own_margin(
    run: str | Path,
    log: Log,
    field: GaussianCollisionField,
    T_world_base: NDArray[np.float64],
    *,
    confidence: float = CONSTANTS.confidence,
) -> float:
    """Return the quantile [m] of the map's surface error within 1 m of a robot's base.

    Args:
        run: folder of the run.
        log: the log of the run, with the same masks.
        field: collision field of the run's map.
        T_world_base: (4, 4) pose of the robot's base.
        confidence: share of the confirmed surface points that the margin covers, 0..1.

    Raises:
        FormatError: the folder is damaged.
        LogError: the log is damaged.
        InputError: no surface point is confirmed there.
    """
    near = audited_error(run, log, field).near(T_world_base[:3, 3], CONSTANTS.radius)
    if not len(near):
        raise InputError(
            f"has no confirmed surface within {CONSTANTS.radius:g} m of the base.",
            file=run,
            field="margin",
            hint="give the margin in metres, or correct the base in scene.yaml",
        )
    return near.quantile(confidence)

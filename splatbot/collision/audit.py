"""Audit of a collision field against confirmed space: missed surfaces, their holes, and false hits in free space."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.collision.confirmed import ConfirmedSpace
from splatbot.collision.field import GaussianCollisionField
from splatbot.protocols import Array
from splatbot.segmentation import clusters


@dataclass(frozen=True)
class AuditConstants:
    """Constants of the audit.

    Args:
        missed_distance: [m] a confirmed surface point farther from the field is missed.
        max_distance: [m] larger distances are clamped.
        hole_link: [m] largest distance of neighbouring missed points of one hole.
        distance_edges: [m] limits of the depth ranges that the audit reports.
        working_distance: [m] surface within this distance of the camera counts for the verdict.
    """

    missed_distance: float = 0.01
    max_distance: float = 0.3
    hole_link: float = 0.01
    distance_edges: tuple[float, ...] = (0.0, 0.5, 0.8, 1.2, 2.0, 4.0)
    working_distance: float = 1.2


CONSTANTS = AuditConstants()


@dataclass(frozen=True, eq=False)
class Hole:
    """Connected part of the confirmed surface that the field misses.

    Args:
        rows: (M,) int64 rows of its points among the confirmed surface points.
        center: (3,) mean of the points [m, world].
        size: (2,) length and width of the points along their principal axes [m].
        depth: largest distance of a point from the field [m].
    """

    rows: NDArray[np.int64]
    center: Array
    size: Array
    depth: float


@dataclass(frozen=True, eq=False)
class SurfaceAudit:
    """Distances of confirmed surface points from a field, and hits of its ellipsoids in confirmed free space.

    Args:
        space: the confirmed points.
        distance: (S,) distance of each surface point from the nearest ellipsoid [m], 0 inside one, at most 0.3.
        gaussian: (S,) int64, row of that Gaussian in the model; -1 if none is within 0.3 m.
        free_hit: (F,) whether a free point collides with the field.
    """

    space: ConfirmedSpace
    distance: Array
    gaussian: NDArray[np.int64]
    free_hit: NDArray[np.bool_]

    @property
    def missed(self) -> NDArray[np.bool_]:
        """Return which surface points (S,) are farther than 1 cm from the field."""
        return self.distance > CONSTANTS.missed_distance

    @property
    def false_hit_share(self) -> float:
        """Share of the confirmed free points that collide with the field; NaN without any."""
        return float(self.free_hit.mean()) if len(self.free_hit) else float("nan")

    def within(self, distance: float = CONSTANTS.working_distance) -> SurfaceAudit:
        """Return the audit of the surface points that were measured within ``distance`` [m] of the camera."""
        return self.select(self.space.depth <= distance)

    def select(self, chosen: NDArray[np.bool_]) -> SurfaceAudit:
        """Return the audit of the chosen (S,) surface points, with all free points."""
        return SurfaceAudit(self.space.select(chosen), self.distance[chosen], self.gaussian[chosen], self.free_hit)

    def missed_share(self) -> float:
        """Return the share of the surface points that the field misses; NaN without any."""
        return float(self.missed.mean()) if len(self.distance) else float("nan")

    def quantile(self, share: float) -> float:
        """Return the distance [m] that a fraction ``share`` (0..1) of the surface points does not exceed."""
        return float(np.quantile(self.distance, share)) if len(self.distance) else float("nan")

    def holes(self) -> list[Hole]:
        """Return the connected parts of the missed surface, longest first; single points are in no hole."""
        rows = np.flatnonzero(self.missed)
        points = self.space.surface[rows]
        found = [self._hole(rows[part]) for part in clusters(points, apart=CONSTANTS.hole_link)]
        return sorted(found, key=lambda hole: -hole.size[0])

    def _hole(self, rows: NDArray[np.int64]) -> Hole:
        points = self.space.surface[rows]
        center = points.mean(axis=0)
        _, _, axes = np.linalg.svd(points - center, full_matrices=False)
        return Hole(rows, center, np.ptp((points - center) @ axes[:2].T, axis=0), float(self.distance[rows].max()))


def audit_surfaces(field: GaussianCollisionField, space: ConfirmedSpace) -> SurfaceAudit:
    """Measure the distance of every confirmed surface point from the field, and count hits in confirmed free space."""
    nearest = field.clearance(space.surface, cut=CONSTANTS.max_distance)
    distance = np.clip(nearest.distance, 0.0, CONSTANTS.max_distance).astype(np.float64)
    return SurfaceAudit(space, distance, nearest.index, field.in_collision(space.free))

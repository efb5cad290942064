"""Obstacles of a plan in addition to the map: support plane, measured surface that the map lacks, unknown space."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Literal

import numpy as np
import torch
from numpy.typing import ArrayLike

from splatbot.collision import GaussianCollisionField, RobotSpheres, UnknownSpace
from splatbot.collision.moving import with_balls
from splatbot.collision.unknown import UnknownPolicy
from splatbot.errors import SplatbotError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.geometry import frame_along, rotation_to_quat
from splatbot.planning import PlanResult, PlanStatus
from splatbot.protocols import Array
from splatbot.results.unknown import CONSTANTS as UNKNOWN
from splatbot.results.unknown import obstacles

Kind = Literal["the map", "the support plane", "measured surface", "unknown space"]


@dataclass(frozen=True)
class SupportTileConstants:
    """Constants of a support plane that plans avoid.

    Args:
        spacing: [m] distance between the centres of its tiles.
        radius: [m] semi-axis of a tile, an ellipsoid. It exceeds the distance from a centre to the farthest point
            between four, so that the tiles overlap.
        thickness: [m] semi-axis across the plane. The upper side of a tile is at the plane.
        above: [m] least height of the base over the plane. An arm that is mounted lower stands next to the
            support, and the plane is not extended to it.
    """

    spacing: float = 0.04
    radius: float = 0.06
    thickness: float = 0.005
    above: float = -0.02


CONSTANTS = SupportTileConstants()


def support_tiles(
    plane: ArrayLike, arm: RobotSpheres, occupied: ArrayLike, *, margin: float = 0.0, n_sigma: float = 2.0
) -> GaussianModel:
    """Return a support plane within reach of an arm as flat Gaussians, without those that the arm touches at the start.

    Args:
        plane: (4,) = (n, d), the plane n · p + d = 0 with the upward unit normal n [m, world].
        arm: the arm.
        occupied: (J,) configuration at which the arm is [rad or m].
        margin: clearance that a plan keeps [m]. Tiles within it of the arm are left out too, because a plan could not
            start there.
        n_sigma: surface of the tiles, in standard deviations.

    Returns:
        The tiles; none if the base is below the plane, or the plane is out of reach.
    """
    n, d = np.asarray(plane, dtype=np.float64)[:3], float(np.asarray(plane)[3])
    base = arm.T_world_base[:3, 3]
    height, reach = float(n @ base + d), arm.reach_radius
    if not CONSTANTS.above <= height <= reach:
        return GaussianModel.empty(0)
    R, spacing = frame_along(n), CONSTANTS.spacing
    steps = np.arange(-np.ceil(reach / spacing), np.ceil(reach / spacing) + 1) * spacing
    x, y = (grid.ravel() for grid in np.meshgrid(steps, steps))
    inside = np.hypot(x, y) <= reach
    foot = base - (height + CONSTANTS.thickness) * n
    means = foot + np.outer(x[inside], R[:, 0]) + np.outer(y[inside], R[:, 1])
    centers = arm.centers(np.asarray(occupied, dtype=np.float64)[None])[0]
    radii = arm.spheres.radii + margin + UNKNOWN.slack
    low = np.abs((centers - foot) @ n) < radii + CONSTANTS.thickness  # near the plane; the others meet no tile
    across = np.linalg.norm(((means[:, None] - centers[low]) @ R)[..., :2], axis=2)
    means = means[~(across < radii[low] + CONSTANTS.radius).any(axis=1)]
    scales = np.array([CONSTANTS.radius, CONSTANTS.radius, CONSTANTS.thickness]) / n_sigma
    count = len(means)
    return GaussianModel.from_activated(
        means=means,
        quats=np.tile(rotation_to_quat(R), (count, 1)),
        scales=np.tile(scales, (count, 1)),
        opacities=np.full(count, 0.99),
        colors=np.full((count, 3), 0.5),
    )


class PlanObstacles:
    """The collision fields of a plan: the map, its support plane, measured surface, and unknown space under a policy.

    Args:
        field: collision field of the map.
        model: the map.
        arm: the arm.
        start: (J,) configuration at which it is [rad or m].
        plane: (4,) support plane of the map, see :func:`support_tiles`. If None, no plane is known or wanted.
        measured: (M, 4) spheres around measured surface outside of the map [m, world], see
            :class:`splatbot.results.measured.MeasuredSurface`. If None, it is not known or not wanted.
        space: unknown space of the map. If None, it counts as free.
        policy: treatment of unknown space.
    """

    def __init__(
        self,
        field: GaussianCollisionField,
        model: GaussianModel,
        arm: RobotSpheres,
        start: ArrayLike,
        *,
        plane: ArrayLike | None = None,
        measured: Array | None = None,
        space: UnknownSpace | None = None,
        policy: UnknownPolicy = "free",
    ) -> None:
        self._field, self._model, self._arm, self.policy = field, model, arm, policy
        self._start, self._plane, self._space = np.asarray(start), plane, space
        self.covers_measured = measured is not None
        spheres = np.zeros((0, 4)) if measured is None else measured
        self._measured = with_balls(GaussianModel.empty(0), spheres, n_sigma=field.n_sigma, observations=_ALWAYS)
        self._tiles, self._solids = 0, GaussianModel.empty(0)

    @property
    def solids(self) -> GaussianModel:
        """Return support plane and unknown space of the latest field as Gaussians: obstacles where the map is empty."""
        return self._solids

    @property
    def map_field(self) -> GaussianCollisionField:
        """Collision field of the map alone."""
        return self._field

    @property
    def covers_support(self) -> bool:
        """Return whether the latest field has the support plane."""
        return self._tiles > 0

    def field(self, margin: float) -> GaussianCollisionField:
        """Return the field for plans with a margin [m]; tiles and unknown space at the arm's start are left out.

        It shares the Gaussians of the map with the field of the map, and its version and gates.
        """
        tiles = GaussianModel.empty(0)
        if self._plane is not None:
            tiles = support_tiles(self._plane, self._arm, self._start, margin=margin, n_sigma=self._field.n_sigma)
        self._tiles = len(tiles)
        unknown = self._unknown(margin)
        self._solids = GaussianModel.concatenate([tiles, unknown])
        solids = GaussianModel.concatenate([tiles, self._measured, unknown])
        if not len(solids):
            return self._field
        # No gate on observations removes a solid.
        solids = replace(solids, observations=torch.full((len(solids),), _ALWAYS, dtype=torch.int32))
        joined = Snapshot(GaussianModel.concatenate([self._model, solids]), map_version=self._field.map_version)
        return self._field.updated(joined, np.zeros(len(joined.model), np.bool_))

    def unknown_field(self, margin: float) -> GaussianCollisionField | None:
        """Return the field of unknown space alone for plans with a margin [m], or None if it counts as free."""
        solids = self._unknown(margin)
        return GaussianCollisionField(solids, self._field.n_sigma) if len(solids) else None

    def _unknown(self, margin: float) -> GaussianModel:
        if self._space is None:
            return GaussianModel.empty(0)
        return obstacles(self._space, self.policy, self._arm, self._start, margin=margin, n_sigma=self._field.n_sigma)

    def kind(self, gaussian: int) -> Kind:
        """Return the kind of obstacle of a row in the latest field."""
        counts = (len(self._model), self._tiles, len(self._measured))
        kinds: tuple[Kind, ...] = ("the map", "the support plane", "measured surface", "unknown space")
        return kinds[int(np.searchsorted(np.cumsum(counts), gaussian, side="right"))]

    def check(self, result: PlanResult) -> None:
        """Check that no obstacle outside of the map makes start or goal of a plan invalid.

        Raises:
            UnmappedObstacleError: one does; the message names the link, the obstacle and the place.
        """
        ends = {PlanStatus.START_STATE_IN_COLLISION: "start", PlanStatus.GOAL_IN_COLLISION: "goal"}
        cause = result.cause
        if result.status not in ends or cause is None or cause.gaussian < 0:
            return
        kind = self.kind(cause.gaussian)
        if kind == "the map":
            return
        meanings = {
            "unknown space": _MEANINGS[self.policy],
            "the support plane": "the support plane of the scene.yaml",
            "measured surface": "surface that two frames measured and the map lacks",
        }
        hints = {
            "unknown space": "map the place from more views, give another goal, or let unknown space be free",
            "the support plane": "give another goal, correct the plane in scene.yaml, or leave it out (`--no-support`)",
            "measured surface": "map again with the robot masked, or give the margin in metres, which ignores it",
        }
        raise UnmappedObstacleError(f"{cause.deep_in(meanings[kind])}.", field=ends[result.status], hint=hints[kind])


_ALWAYS = 1 << 30  # observations of solids
_MEANINGS = {
    "cautious": "space in which two frames looked and measured no depth",
    "occupied": "space that no frame saw to be empty",
    "free": "unknown space",
}


class UnmappedObstacleError(SplatbotError):
    """The start or the goal of a plan is in an obstacle that is not in the map."""

    http_status = 422

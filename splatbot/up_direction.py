"""Decision on the up direction of a map: a sensor, the arm or the user decide; an estimate states its doubts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, transform_points
from splatbot.workspace import Workspace, fit_workspace

Array = NDArray[np.float64]


@dataclass(frozen=True)
class UpDirectionConstants:
    """Constants of the doubts about an estimated support plane.

    Args:
        pitches: [deg] pitches of the camera below the horizon that are tried as up directions.
        same_plane: [deg] largest angle between the normals of equal candidates.
        max_upward_look: [deg] largest pitch of the camera above the horizon.
        max_roll: [deg] largest roll of the camera without a doubt.
        max_pitch: [deg] largest pitch below the horizon without a doubt; beyond it, the plane may be a wall.
        cell: [m] side of the cells in which a plane is occupied.
        min_height: [m] least height of objects above the plane.
        max_height: [m] largest height of objects above the plane.
        min_standing: least number of points on the plane's area that stand on it, relative to the plane's points.
        rival: least surplus of points that stand on another plane, relative to the chosen one, for a doubt.
        max_beneath: largest number of points beneath the plane's area, relative to those that stand on it.
    """

    pitches: tuple[float, ...] = (0.0, 45.0, 90.0)
    same_plane: float = 10.0
    max_upward_look: float = 10.0
    max_roll: float = 25.0
    max_pitch: float = 70.0
    cell: float = 0.02
    min_height: float = 0.02
    max_height: float = 0.3
    min_standing: float = 0.01
    rival: float = 0.4
    max_beneath: float = 0.5


CONSTANTS = UpDirectionConstants()


@dataclass(frozen=True, eq=False)
class WorkspaceEstimate:
    """An estimated workspace with the reasons to doubt it.

    Args:
        workspace: the estimate.
        decided_by: source of the up direction.
        doubts: reasons against the estimate; without any, it may be used.
        others: other candidates.
        directions: (3,) usual upward directions with a surface that faces them.
    """

    workspace: Workspace
    decided_by: str
    doubts: tuple[str, ...] = ()
    others: tuple[Workspace, ...] = ()
    directions: tuple[Array, ...] = ()


def estimate_workspace(
    model: GaussianModel, up: ArrayLike | None = None, *, decided_by: str = "--up", seed: int = 0
) -> WorkspaceEstimate:
    """Estimate the support plane and a robot's base on it, and judge the estimate.

    Without ``up``, planes are fitted for cameras that look ahead, obliquely down and straight down. Planes that the
    camera would see from below are dropped. The estimate is doubtful if the remaining ones disagree, if nothing stands
    on the plane, or if points are beneath it. It is also doubtful if the camera is rolled or looks straight down, where
    a wall looks alike.

    Args:
        model: a map whose world frame is its first camera.
        up: (3,) upward direction in the world. If None, it is estimated.
        decided_by: source of ``up``.
        seed: seed of the RANSAC samples.

    Raises:
        InputError: the map has no such plane, or ``up`` is no direction.
    """
    points = model.means.double().numpy()
    if up is not None:
        found = fit_workspace(model, up=up, seed=seed)
        return WorkspaceEstimate(found, decided_by, tuple(_doubts_of_support(found, points)))
    (found, *others), directions = _candidates(model, seed)
    doubts = [*_doubts_of_view(found), *_doubts_of_support(found, points)]
    if others:
        angles = ", ".join(f"{_angle(found, other):.0f}°" for other in others)
        doubts.append(f"other planes with objects on them are turned by {angles}")
    return WorkspaceEstimate(found, "estimated", tuple(doubts), tuple(others), directions)


def _candidates(model: GaussianModel, seed: int) -> tuple[list[Workspace], tuple[Array, ...]]:
    """Return different planes that can be supports, that with most points on it first, and the directions with one.

    Weak rivals are left out.
    """
    points = model.means.double().numpy()
    found: list[tuple[int, Workspace]] = []
    directions: list[Array] = []
    failure: InputError | None = None
    for pitch in np.radians(CONSTANTS.pitches):
        up = np.array([0.0, -np.cos(pitch), -np.sin(pitch)])
        try:
            place = fit_workspace(model, up=up, seed=seed)
        except InputError as error:
            failure = error
            continue
        directions.append(up)
        looks_up = _normal(place)[1] > np.sin(np.radians(CONSTANTS.max_upward_look))
        if looks_up or any(_angle(place, other) < CONSTANTS.same_plane for _, other in found):
            continue
        standing, beneath, _ = support_counts(place, points)
        found.append((standing - beneath, place))
    if not found:
        raise failure or InputError("has no upward surface.", field="map", hint="give the up direction: --up X Y Z")
    found.sort(key=lambda pair: -pair[0])
    least = max(CONSTANTS.rival * found[0][0], 1.0)
    return [found[0][1], *(place for surplus, place in found[1:] if surplus >= least)], tuple(directions)


def support_counts(place: Workspace, points: Array) -> tuple[int, int, int]:
    """Count the points (N, 3) that stand on the occupied area of a plane, that are beneath it, and that are on it."""
    assert place.T_world_base is not None
    local = transform_points(inverse(place.T_world_base), points)
    on = np.abs(local[:, 2]) < CONSTANTS.min_height / 2
    cells = np.floor(local[:, :2] / CONSTANTS.cell).astype(np.int64)
    keys = cells[:, 0] * 1_000_003 + cells[:, 1]
    over = np.isin(keys, np.unique(keys[on]))
    heights = np.abs(local[:, 2])
    near = over & (heights > CONSTANTS.min_height) & (heights < CONSTANTS.max_height)
    above = local[:, 2] > 0
    return int((near & above).sum()), int((near & ~above).sum()), int(on.sum())


def _doubts_of_support(place: Workspace, points: Array) -> Sequence[str]:
    standing, beneath, on = support_counts(place, points)
    if standing < CONSTANTS.min_standing * on:
        return ["nothing stands on the plane, so it is perhaps no table or floor"]
    if beneath > CONSTANTS.max_beneath * standing:
        return [f"{beneath} points are beneath the plane and {standing} above it, so it is perhaps no support"]
    return []


def _doubts_of_view(place: Workspace) -> Sequence[str]:
    normal = _normal(place)
    roll = np.degrees(np.arcsin(min(abs(float(normal[0])), 1.0)))
    pitch = np.degrees(np.arcsin(np.clip(-float(normal[2]), -1.0, 1.0)))
    doubts = []
    if roll > CONSTANTS.max_roll:
        doubts.append(f"the first camera would be rolled by {roll:.0f}°")
    if pitch > CONSTANTS.max_pitch:
        doubts.append(f"the first camera would look down by {pitch:.0f}°, from where a wall in front of it looks alike")
    return doubts


def _normal(place: Workspace) -> Array:
    assert place.support_plane is not None
    return place.support_plane[:3]


def _angle(a: Workspace, b: Workspace) -> float:
    """Return the angle between the normals of two planes [deg]."""
    return float(np.degrees(np.arccos(np.clip(_normal(a) @ _normal(b), -1.0, 1.0))))

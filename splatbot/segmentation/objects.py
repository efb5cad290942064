"""A map as a support and the objects on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property

import cv2
import numpy as np
import torch
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.geometry import inverse, transform_points
from splatbot.protocols import Array
from splatbot.segmentation.clusters import clusters
from splatbot.segmentation.faces import cut_at_steps, local_normals, nearest_of, region
from splatbot.segmentation.plane import NEAR, Support, find_support, given_support
from splatbot.segmentation.concave_edges import cut_in_room
from splatbot.workspace import NamedPlace

OPAQUE = 0.3  # fainter Gaussians are no surface
LOWEST, ABOVE = 0.002, 0.008  # [m] over the support; lower is its own noise, of which it has this much at most
FEWEST, LARGEST = 40, 0.35  # Gaussians of an object; [m] across
_APART = 0.012  # [m] between Gaussians of one object
_LEDGE = 0.15  # [m] across, from where on a thing may be a support of others
_SHARE, _PLANES, _DEEPEST = 0.1, 3, 1  # of its points that its plane has; planes looked at; supports on supports
_SPACED = 2.2  # times the usual size of Gaussians: in a coarse map they are farther apart
_AROUND = 0.05  # [m] around what was pointed at that is looked at
_STRAY = 0.006  # [m] around an object within which faint Gaussians are its own
_OVER = 0.7  # of what is above a plane that is over it
_ALONG, _MOSTLY = 0.8, 0.5  # cosine between normals along a plane and its own; share of its points that are so


@dataclass(frozen=True, eq=False)
class MapObject:
    """Gaussians that hang together on the support.

    Args:
        number: in its scene, from 0; the one with most Gaussians first.
        rows: (M,) int64 of the map.
        center: (3,) of its box [m, world].
        size: (3,) of its box along its own long side, its own short side, and upwards [m].
        color: (3,) median RGB in 0..1.
        name: from a scene file; empty: it has none.
        aliases: other names.
    """

    number: int
    rows: NDArray[np.int64]
    center: Array
    size: Array
    color: Array
    name: str = ""
    aliases: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class SegmentedMap:
    """One state of the map and what is in it.

    Args:
        model: the map.
        T_world_base: (4, 4), a frame whose z is up; the robot's base, where there is one.
        support: in that frame; None: there is no level plane.
        objects: on it.
        labels: (N,) int32 of the map's Gaussians: the number of its object, -1 for none, -2 - k: of the k-th support.
        supports: the support, and further ones that stand on it or beside it, as the seat of a stool.
        map_version: of the map.
    """

    model: GaussianModel
    T_world_base: Array
    support: Support | None
    objects: tuple[MapObject, ...]
    labels: NDArray[np.int32] = field(repr=False)
    supports: tuple[Support, ...] = ()
    names: tuple[NamedPlace, ...] = ()
    map_version: int = 0

    @cached_property
    def points(self) -> Array:
        """Means (N, 3) of all Gaussians in the base's frame [m]."""
        return transform_points(inverse(self.T_world_base), self.model.means.detach().double().numpy())

    @cached_property
    def solid(self) -> NDArray[np.bool_]:
        """Which Gaussians (N,) are a surface that was measured."""
        return solid_rows(self.model)

    def under(self, points: Array) -> Support | None:
        """The highest support that is not above points (P, 3) of the base's frame [m]; None: there is none."""
        low = np.percentile(points, 5, axis=0)
        below = [s for s in self.supports if s.height(low[None])[0] > -NEAR]
        return min(below, key=lambda s: float(s.height(low[None])[0])) if below else None

    def grown(self, seeds: NDArray[np.int64]) -> NDArray[np.int64]:
        """Rows of the faces that lie mostly in the rows ``seeds``, without the support; for what is no object."""
        if not len(seeds):
            return seeds
        near = self.points[seeds]
        low, high = np.percentile(near, [2, 98], axis=0) + np.array([[-_AROUND], [_AROUND]])
        rows = np.flatnonzero(self.solid & ((self.points > low) & (self.points < high)).all(axis=1))
        rows = rows[self.labels[rows] >= -1]
        if len(rows) < FEWEST:
            return rows[:0]
        chosen = np.zeros(len(self.model), np.bool_)
        chosen[seeds] = True
        return rows[region(self.points[rows], chosen[rows], fewest=FEWEST)]

    @property
    def up(self) -> Array:
        """(3,) unit, in the world."""
        return np.asarray(self.T_world_base[:3, 2])


def solid_rows(model: GaussianModel) -> NDArray[np.bool_]:
    """Which Gaussians (N,) are a surface that was measured."""
    return np.asarray((model.opacities.detach().numpy() >= OPAQUE) & (model.observations.numpy() >= 1))


def segment(
    source: GaussianModel | Snapshot,
    T_world_base: ArrayLike,
    *,
    box: ArrayLike | None = None,
    plane: ArrayLike | None = None,
    names: Sequence[NamedPlace] = (),
    apart: float = _APART,
    cut: bool = True,
    observers: Array | None = None,
) -> SegmentedMap:
    """Remove the support of a map and gather what stands on it.

    Args:
        source: the map.
        T_world_base: (4, 4), a frame whose z is up.
        box: (2, 3) corners of the space that is looked at, in that frame [m]; None: 2 m around.
        plane: (4,) = (n, d), the support where it is known: n · p + d = 0 [world]; None: it is looked for.
        names: what a scene file calls things.
        apart: objects have more than this between their Gaussians [m]; in a coarse map it is more.
        cut: what hangs together may be several things: one that is wide may be a support of others, and it is cut at
            steps between level faces. Without, it is one, as a mallet is whose head is higher than its handle.
        observers: (N, 3) where each Gaussian was seen from [m, world], NaN where that is not known. With them, what
            hangs together and is too large for a thing, as a shelf with all that leans on its walls, is cut where
            faces meet at concave edges; without, it is no object.

    Raises:
        InputError: nothing of the map is in the box, or the observers are of another map.
    """
    model = source.model if isinstance(source, Snapshot) else source
    T = np.asarray(T_world_base, dtype=np.float64)
    points = transform_points(inverse(T), model.means.detach().double().numpy())
    if observers is not None and observers.shape != points.shape:
        raise InputError(f"is {observers.shape}.", field="observers", hint=f"give ({len(points)}, 3)")
    eyes = None if observers is None else transform_points(inverse(T), observers)
    low, high = np.array([[-2.0] * 3, [2.0] * 3]) if box is None else np.asarray(box, dtype=np.float64)
    used = np.flatnonzero(solid_rows(model) & ((points >= low - ABOVE) & (points <= high)).all(axis=1))
    if not len(used):
        raise InputError(f"has nothing between {low.tolist()} and {high.tolist()}.", field="map", hint="see scene.yaml")
    apart = max(apart, _SPACED * float(model.scales[torch.from_numpy(used)].amax(dim=1).median()))
    support = find_support(points[used]) if plane is None else _known(plane, T, points[used])
    above = used if support is None else used[above_support(support, points[used])]
    labels = np.full(len(model), -1, np.int32)
    if support is not None:
        labels[used[np.abs(support.height(points[used])) < NEAR]] = -2
    supports = [] if support is None else [support]
    objects: list[MapObject] = []
    colors = model.colors.detach().double().numpy()
    for rows in sorted(
        _things(points, eyes, above, apart, _DEEPEST, labels, supports, cut),
        key=lambda rows: (-len(rows), int(rows[0])),
    ):
        labels[rows] = len(objects)
        objects.append(_described(len(objects), rows, points[rows], colors[rows], T))
    objects = _with_faint(objects, labels, points, used)
    named = _with_names(tuple(objects), points, T, names)
    version = source.map_version if isinstance(source, Snapshot) else 0
    return SegmentedMap(model, T, support, named, labels, tuple(supports), tuple(names), version)


def _known(plane: ArrayLike, T_world_base: Array, points: Array) -> Support:
    """A plane of the world in the base's frame."""
    values = np.asarray(plane, dtype=np.float64)
    normal = T_world_base[:3, :3].T @ values[:3]
    offset = -float(values[3] + values[:3] @ T_world_base[:3, 3])
    return given_support(points, normal, offset)


def _things(
    points: Array,
    eyes: Array | None,
    used: NDArray[np.int64],
    apart: float,
    deeper: int,
    labels: NDArray[np.int32],
    supports: list[Support],
    cut: bool,
) -> list[NDArray[np.int64]]:
    """Rows of what hangs together; what stands together on a support of its own, as a stool or a shelf, apart."""
    found: list[NDArray[np.int64]] = []
    for part in clusters(points[used], apart=apart):
        rows = used[part]
        wide = float(np.ptp(points[rows], axis=0).max())
        ledge = _ledge(points[rows]) if cut and deeper and wide > _LEDGE else None
        if ledge is not None:
            on = rows[above_support(ledge, points[rows])]
            supports.append(replace(ledge, inside=np.zeros(0, np.bool_)))
            labels[rows[np.abs(ledge.height(points[rows])) < NEAR]] = -1 - len(supports)
            found += _things(points, eyes, on, apart, deeper - 1, labels, supports, cut)
        elif cut and eyes is not None and wide > LARGEST:
            parts = cut_in_room(points[rows], eyes[rows], apart=apart, fewest=FEWEST)
            found += [rows[some] for some in parts if np.ptp(points[rows[some]], axis=0).max() <= LARGEST]
        elif len(rows) >= FEWEST and wide <= LARGEST:
            found += [rows[some] for some in cut_at_steps(points[rows], fewest=FEWEST)] if cut else [rows]
    return found


def _ledge(points: Array) -> Support | None:
    """The lowest of the level planes that hold most points (P, 3), if something stands on it."""
    left, best = np.ones(len(points), np.bool_), None
    for _ in range(_PLANES):
        plane = find_support(points[left])
        if plane is None or plane.inside.sum() < _SHARE * len(points):
            break
        if (best is None or plane.offset < best.offset) and _holds(plane, points) and _level(plane, points, left):
            best = plane
        left[np.flatnonzero(left)[plane.inside]] = False
    if best is None:
        return None
    away = best.height(points)
    return Support(best.normal, best.offset, best.error, np.abs(away) < NEAR)


def _level(plane: Support, points: Array, left: NDArray[np.bool_]) -> bool:
    """Whether the plane's points are a face along it, not where it cuts through walls."""
    rows = np.flatnonzero(left)[plane.inside]
    normals = local_normals(points, rows[:: max(1, len(rows) // 300)])
    return float((np.abs(normals @ plane.normal) > _ALONG).mean()) > _MOSTLY


def _holds(plane: Support, points: Array) -> bool:
    """Whether what is above the plane is over it, as on a shelf, and not beside it."""
    away = plane.height(points)
    on = points[away > ABOVE][:, :2].astype(np.float32)
    if len(on) < FEWEST:
        return False
    hull = cv2.convexHull(points[np.abs(away) < NEAR][:, :2].astype(np.float32))
    some = on[:: max(1, len(on) // 200)]
    over = [cv2.pointPolygonTest(hull, (float(x), float(y)), False) >= 0 for x, y in some]
    return float(np.mean(over)) > _OVER


def above_support(support: Support, points: Array) -> NDArray[np.bool_]:
    """Which points (P, 3) are higher than the support's own noise."""
    height = support.height(points)
    near = np.abs(height[np.abs(height) < NEAR])
    noise = 1.48 * float(np.median(near)) if len(near) else 0.0
    return np.asarray(height > np.clip(3.0 * noise, LOWEST, ABOVE))


def _with_faint(
    objects: list[MapObject], labels: NDArray[np.int32], points: Array, used: NDArray[np.int64]
) -> list[MapObject]:
    """Objects with the faint and stray Gaussians that lie within 6 mm of them: they are no obstacles of their own."""
    if not objects:
        return objects
    own = np.flatnonzero(labels >= 0)
    low, high = points[own].min(axis=0) - _STRAY, points[own].max(axis=0) + _STRAY
    solid = np.zeros(len(points), np.bool_)
    solid[used] = True
    faint = np.flatnonzero(~solid & ((points > low) & (points < high)).all(axis=1))
    if len(faint):
        nearest, square = nearest_of(points[own], points[faint])
        near = square < _STRAY**2
        labels[faint[near]] = labels[own[nearest[near]]]
    return [replace(o, rows=np.flatnonzero(labels == o.number)) for o in objects]


def _described(number: int, rows: NDArray[np.int64], points: Array, colors: Array, T: Array) -> MapObject:
    (x, y), sides, _ = cv2.minAreaRect(points[:, :2].astype(np.float32))
    low, high = np.percentile(points[:, 2], [1, 99])
    size = np.array([max(sides), min(sides), high - low])
    center = transform_points(T, np.array([x, y, (low + high) / 2]))
    return MapObject(number, rows, center, size, np.median(colors, axis=0))


def _with_names(
    objects: tuple[MapObject, ...], points: Array, T: Array, names: Sequence[NamedPlace]
) -> tuple[MapObject, ...]:
    """Each place names the object whose Gaussians are nearest, if one is within 5 cm."""
    found = list(objects)
    for place in names:
        at = transform_points(inverse(T), place.at)
        away = [float(np.linalg.norm(points[o.rows] - at, axis=1).min()) for o in objects]
        if away and min(away) < 0.05:
            k = int(np.argmin(away))
            found[k] = replace(objects[k], name=place.name, aliases=place.aliases)
    return tuple(found)

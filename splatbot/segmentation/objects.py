"""Segmentation of a map: support planes and the objects on them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
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
from splatbot.segmentation.concave_edges import split_at_concave_edges
from splatbot.segmentation.faces import local_normals, nearest_of, region, split_at_steps
from splatbot.segmentation.plane import NEAR, Support, find_support, given_support
from splatbot.segmentation.rectangle import fit_rectangle
from splatbot.workspace import NamedPlace


@dataclass(frozen=True)
class SegmentationConstants:
    """Constants of the segmentation into objects."""

    object_distance: float = 0.012
    """Smallest distance [m] between objects. A larger one merges objects that stand close to each other, a smaller one
    splits objects at gaps of the map."""
    min_support_extent: float = 0.15
    """Smallest extent [m] of a cluster that may contain a support, such as a book with objects on it."""
    min_support_fraction: float = 0.1
    """Smallest share [1] of a cluster's points that are on its support."""
    max_support_planes: int = 3
    """Largest number of planes [1] of a cluster that are tried as supports."""
    max_nested_supports: int = 1
    """Largest depth [1] of supports on supports."""
    spacing_factor: float = 2.2
    """Smallest distance [1] between objects relative to the median size of the Gaussians, for coarse maps. A smaller
    one splits objects into single Gaussians."""
    seed_margin: float = 0.05
    """Margin [m] around seeds in which faces are searched."""
    stray_distance: float = 0.006
    """Distance [m] from an object within which faint Gaussians belong to it. A larger one adds shadows on the
    support."""
    min_over_fraction: float = 0.7
    """Smallest share [1] of the points above a support that are over its area. A smaller one takes leaning objects for
    supports."""
    min_support_cosine: float = 0.8
    """Smallest cosine [1] between the normals of points on a support and its own."""
    min_level_fraction: float = 0.5
    """Smallest share [1] of a support's points with such normals. A smaller one takes the points of a curved object for
    a support."""
    max_name_distance: float = 0.05
    """Largest distance [m] between a named place and its object. A larger one names a neighbour if the object is
    missing."""
    min_opacity: float = 0.3
    """Smallest opacity [1] of a Gaussian that represents a surface."""
    min_height: float = 0.002
    """Smallest height [m] above a support below which points are its noise. The height is three standard deviations of
    the noise within these limits."""
    max_height: float = 0.008
    """Largest height [m] above a support below which points are its noise. A larger one loses flat objects in noisy
    maps."""
    min_gaussians: int = 40
    """Smallest number of Gaussians [1] of an object."""
    max_extent: float = 0.35
    """Largest extent [m] of an object. A larger cluster is split, and parts that are larger are left out."""


CONSTANTS = SegmentationConstants()


@dataclass(frozen=True, eq=False)
class MapObject:
    """An object instance: connected Gaussians on a support.

    Args:
        number: index in its scene, by decreasing number of Gaussians.
        rows: (M,) int64 indices of its Gaussians in the map.
        center: (3,) centre of the bounding box [m, world].
        size: (3,) long side, short side and height of the upright bounding box [m].
        color: (3,) median RGB in 0..1.
        name: name from a scene file, or empty.
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
    """A segmented map: supports and object instances.

    Args:
        model: the map.
        T_world_base: (4, 4) pose of a frame with z up, usually that of the robot's base.
        support: largest support plane in that frame. If None, the map has no horizontal plane.
        objects: the objects.
        labels: (N,) int32 label of each Gaussian: number of its object, -1 for none, -2 - k for the k-th support.
        supports: all supports: the largest, and others on it or next to it, such as the seat of a stool.
        names: named places of a scene file.
        map_version: version of the map.
        structures: objects that are structure, as pieces of walls, by number, and why; empty if that is not known.
    """

    model: GaussianModel
    T_world_base: Array
    support: Support | None
    objects: tuple[MapObject, ...]
    labels: NDArray[np.int32] = field(repr=False)
    supports: tuple[Support, ...] = ()
    names: tuple[NamedPlace, ...] = ()
    map_version: int = 0
    structures: Mapping[int, str] = field(default_factory=dict)

    @cached_property
    def points(self) -> Array:
        """Means (N, 3) of all Gaussians in the base's frame [m], read-only."""
        points = transform_points(inverse(self.T_world_base), self.model.means.detach().double().numpy())
        points.flags.writeable = False
        return points

    @cached_property
    def solid(self) -> NDArray[np.bool_]:
        """Return which Gaussians (N,) represent an observed surface."""
        return solid_rows(self.model)

    def under(self, points: Array) -> Support | None:
        """Return the highest support below points (P, 3) in the base frame [m], or None without one."""
        low = np.percentile(points, 5, axis=0)
        below = [s for s in self.supports if s.height(low[None])[0] > -NEAR]
        return min(below, key=lambda s: float(s.height(low[None])[0])) if below else None

    def grown(self, seeds: NDArray[np.int64]) -> NDArray[np.int64]:
        """Return the rows of the faces that lie mostly in ``seeds``, without supports; used for unsegmented objects."""
        if not len(seeds):
            return seeds
        near = self.points[seeds]
        low, high = np.percentile(near, [2, 98], axis=0) + np.array([[-CONSTANTS.seed_margin], [CONSTANTS.seed_margin]])
        rows = np.flatnonzero(self.solid & ((self.points > low) & (self.points < high)).all(axis=1))
        rows = rows[self.labels[rows] >= -1]
        if len(rows) < CONSTANTS.min_gaussians:
            return rows[:0]
        chosen = np.zeros(len(self.model), np.bool_)
        chosen[seeds] = True
        return rows[region(self.points[rows], chosen[rows], fewest=CONSTANTS.min_gaussians)]

    @property
    def up(self) -> Array:
        """(3,) unit up axis [world]."""
        return np.asarray(self.T_world_base[:3, 2])


def solid_rows(model: GaussianModel) -> NDArray[np.bool_]:
    """Return which Gaussians (N,) represent an observed surface: opaque and observed by a keyframe."""
    return np.asarray((model.opacities.detach().numpy() >= CONSTANTS.min_opacity) & (model.observations.numpy() >= 1))


def least_gap(model: GaussianModel, rows: NDArray[np.int64], apart: float = CONSTANTS.object_distance) -> float:
    """Return the distance [m] between objects of a map: ``apart``, or more if the Gaussians of ``rows`` are coarse."""
    return max(apart, CONSTANTS.spacing_factor * float(model.scales[torch.from_numpy(rows)].amax(dim=1).median()))


def segment(
    source: GaussianModel | Snapshot,
    T_world_base: ArrayLike,
    *,
    box: ArrayLike | None = None,
    plane: ArrayLike | None = None,
    names: Sequence[NamedPlace] = (),
    apart: float = CONSTANTS.object_distance,
    cut: bool = True,
    observers: Array | None = None,
) -> SegmentedMap:
    """Remove the support plane of a map and cluster the remaining Gaussians into objects.

    Args:
        source: the map.
        T_world_base: (4, 4) pose of a frame with z up.
        box: (2, 3) corners of the workspace in that frame [m]. If None, a cube of 4 m around the origin is used.
        plane: (4,) known support (n, d) with n · p + d = 0 [world]. If None, the support is detected.
        names: named places of a scene file.
        apart: minimum distance between the Gaussians of two objects [m]; it is larger in a coarse map.
        cut: split clusters: a wide one may contain a support with objects on it, and touching objects are split at
            steps between parallel faces. If False, a cluster is one object, such as a mallet whose head is higher than
            its handle.
        observers: (N, 3) camera centre from which each Gaussian was observed [m, world], NaN where unknown. With them,
            clusters that are too large for an object are split at concave edges, such as a shelf with objects at its
            walls. If None, such clusters are not objects.

    Raises:
        InputError: the box contains no Gaussians, or the observers do not belong to the map.
    """
    model = source.model if isinstance(source, Snapshot) else source
    T = np.asarray(T_world_base, dtype=np.float64)
    points = transform_points(inverse(T), model.means.detach().double().numpy())
    if observers is not None and observers.shape != points.shape:
        raise InputError(f"is {observers.shape}.", field="observers", hint=f"give ({len(points)}, 3)")
    eyes = None if observers is None else transform_points(inverse(T), observers)
    low, high = np.array([[-2.0] * 3, [2.0] * 3]) if box is None else np.asarray(box, dtype=np.float64)
    used = np.flatnonzero(solid_rows(model) & ((points >= low - CONSTANTS.max_height) & (points <= high)).all(axis=1))
    if not len(used):
        raise InputError(f"has nothing between {low.tolist()} and {high.tolist()}.", field="map", hint="see scene.yaml")
    apart = least_gap(model, used, apart)
    support = find_support(points[used]) if plane is None else _known(plane, T, points[used])
    above = used if support is None else used[above_support(support, points[used])]
    labels = np.full(len(model), -1, np.int32)
    if support is not None:
        labels[used[np.abs(support.height(points[used])) < NEAR]] = -2
    supports = [] if support is None else [support]
    objects: list[MapObject] = []
    colors = model.colors.detach().double().numpy()
    for rows in sorted(
        _object_rows(points, eyes, above, apart, CONSTANTS.max_nested_supports, labels, supports, cut),
        key=lambda rows: (-len(rows), int(rows[0])),
    ):
        labels[rows] = len(objects)
        objects.append(_described(len(objects), rows, points[rows], colors[rows], T))
    objects = _with_faint(objects, labels, points, used)
    named = _with_names(tuple(objects), points, T, names)
    version = source.map_version if isinstance(source, Snapshot) else 0
    return SegmentedMap(model, T, support, named, labels, tuple(supports), tuple(names), version)


def _known(plane: ArrayLike, T_world_base: Array, points: Array) -> Support:
    """Transform a plane (n, d) with n · p + d = 0 from the world to the base frame."""
    values = np.asarray(plane, dtype=np.float64)
    normal = T_world_base[:3, :3].T @ values[:3]
    offset = -float(values[3] + values[:3] @ T_world_base[:3, 3])
    return given_support(points, normal, offset)


def _object_rows(
    points: Array,
    eyes: Array | None,
    used: NDArray[np.int64],
    apart: float,
    deeper: int,
    labels: NDArray[np.int32],
    supports: list[Support],
    cut: bool,
) -> list[NDArray[np.int64]]:
    """Return the rows of each object; clusters on a support of their own, as on a stool or a shelf, are separated."""
    found: list[NDArray[np.int64]] = []
    for part in clusters(points[used], apart=apart):
        rows = used[part]
        wide = float(np.ptp(points[rows], axis=0).max())
        ledge = _nested_support(points[rows]) if cut and deeper and wide > CONSTANTS.min_support_extent else None
        if ledge is not None:
            on = rows[above_support(ledge, points[rows])]
            supports.append(replace(ledge, inside=np.zeros(0, np.bool_)))
            labels[rows[np.abs(ledge.height(points[rows])) < NEAR]] = -1 - len(supports)
            found += _object_rows(points, eyes, on, apart, deeper - 1, labels, supports, cut)
        elif cut and eyes is not None and wide > CONSTANTS.max_extent:
            parts = split_at_concave_edges(points[rows], eyes[rows], apart=apart, fewest=CONSTANTS.min_gaussians)
            found += [rows[some] for some in parts if np.ptp(points[rows[some]], axis=0).max() <= CONSTANTS.max_extent]
        elif len(rows) >= CONSTANTS.min_gaussians and wide <= CONSTANTS.max_extent:
            found += (
                [rows[some] for some in split_at_steps(points[rows], fewest=CONSTANTS.min_gaussians)] if cut else [rows]
            )
    return found


def _nested_support(points: Array) -> Support | None:
    """Return the lowest of the three largest horizontal planes of a cluster (P, 3) with objects on it, or None."""
    left, best = np.ones(len(points), np.bool_), None
    for _ in range(CONSTANTS.max_support_planes):
        plane = find_support(points[left])
        if plane is None or plane.inside.sum() < CONSTANTS.min_support_fraction * len(points):
            break
        if (best is None or plane.offset < best.offset) and _holds(plane, points) and _level(plane, points, left):
            best = plane
        left[np.flatnonzero(left)[plane.inside]] = False
    if best is None:
        return None
    away = best.height(points)
    return Support(best.normal, best.offset, best.error, np.abs(away) < NEAR)


def _level(plane: Support, points: Array, left: NDArray[np.bool_]) -> bool:
    """Return whether the inliers form a face along the plane, rather than an intersection of the plane with walls."""
    rows = np.flatnonzero(left)[plane.inside]
    normals = local_normals(points, rows[:: max(1, len(rows) // 300)])
    return float((np.abs(normals @ plane.normal) > CONSTANTS.min_support_cosine).mean()) > CONSTANTS.min_level_fraction


def _holds(plane: Support, points: Array) -> bool:
    """Return whether the points above the plane are over its area, as on a shelf, and not next to it."""
    away = plane.height(points)
    on = points[away > CONSTANTS.max_height][:, :2].astype(np.float32)
    if len(on) < CONSTANTS.min_gaussians:
        return False
    hull = cv2.convexHull(points[np.abs(away) < NEAR][:, :2].astype(np.float32))
    some = on[:: max(1, len(on) // 200)]
    over = [cv2.pointPolygonTest(hull, (float(x), float(y)), False) >= 0 for x, y in some]
    return float(np.mean(over)) > CONSTANTS.min_over_fraction


def above_support(support: Support, points: Array) -> NDArray[np.bool_]:
    """Return which points (P, 3) are higher than three standard deviations of the support's noise.

    The robust standard deviation is 1.48 median |height| of the inliers; the threshold is clipped to 2..8 mm.
    """
    height = support.height(points)
    near = np.abs(height[np.abs(height) < NEAR])
    noise = 1.48 * float(np.median(near)) if len(near) else 0.0
    return np.asarray(height > np.clip(3.0 * noise, CONSTANTS.min_height, CONSTANTS.max_height))


def _with_faint(
    objects: list[MapObject], labels: NDArray[np.int32], points: Array, used: NDArray[np.int64]
) -> list[MapObject]:
    """Add faint and stray Gaussians within 6 mm of an object to it, so that they are no separate obstacles."""
    if not objects:
        return objects
    own = np.flatnonzero(labels >= 0)
    low, high = points[own].min(axis=0) - CONSTANTS.stray_distance, points[own].max(axis=0) + CONSTANTS.stray_distance
    solid = np.zeros(len(points), np.bool_)
    solid[used] = True
    faint = np.flatnonzero(~solid & ((points > low) & (points < high)).all(axis=1))
    if len(faint):
        nearest, square = nearest_of(points[own], points[faint])
        near = square < CONSTANTS.stray_distance**2
        labels[faint[near]] = labels[own[nearest[near]]]
    return [replace(o, rows=np.flatnonzero(labels == o.number)) for o in objects]


def _described(number: int, rows: NDArray[np.int64], points: Array, colors: Array, T: Array) -> MapObject:
    base = fit_rectangle(points[:, :2])
    low, high = np.percentile(points[:, 2], [1, 99])
    size = np.array([base.sides.max(), base.sides.min(), high - low])
    center = transform_points(T, np.array([*base.center, (low + high) / 2]))
    return MapObject(number, rows, center, size, np.median(colors, axis=0))


def _with_names(
    objects: tuple[MapObject, ...], points: Array, T: Array, names: Sequence[NamedPlace]
) -> tuple[MapObject, ...]:
    """Assign each named place to the object with the nearest Gaussian, within 5 cm."""
    found = list(objects)
    for place in names:
        at = transform_points(inverse(T), place.at)
        away = [float(np.linalg.norm(points[o.rows] - at, axis=1).min()) for o in objects]
        if away and min(away) < CONSTANTS.max_name_distance:
            k = int(np.argmin(away))
            found[k] = replace(objects[k], name=place.name, aliases=place.aliases)
    return tuple(found)

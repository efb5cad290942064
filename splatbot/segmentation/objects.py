"""A map as a support and the objects on it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.geometry import inverse, transform_points
from splatbot.protocols import Array
from splatbot.segmentation.clusters import clusters
from splatbot.segmentation.plane import Support, find_support

OPAQUE = 0.3  # fainter Gaussians are no surface
ABOVE = 0.008  # [m] over the support: lower is its own noise
FEWEST, LARGEST = 40, 0.35  # Gaussians of an object; [m] across
_APART = 0.012  # [m] between Gaussians of one object


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
class NamedPlace:
    """What a scene file calls the object at a place.

    Args:
        name: of the object.
        at: (3,) a point in or on it [m, world].
        aliases: other names.
    """

    name: str
    at: Array
    aliases: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class MapScene:
    """One state of the map and what is in it.

    Args:
        model: the map.
        T_world_base: (4, 4), a frame whose z is up; the robot's base, where there is one.
        support: in that frame; None: there is no level plane.
        objects: on it.
        labels: (N,) int32 of the map's Gaussians: the number of its object, -1 for none.
        map_version: of the map.
    """

    model: GaussianModel
    T_world_base: Array
    support: Support | None
    objects: tuple[MapObject, ...]
    labels: NDArray[np.int32] = field(repr=False)
    map_version: int = 0

    @property
    def up(self) -> Array:
        """(3,) unit, in the world."""
        return np.asarray(self.T_world_base[:3, 2])


def segment(
    source: GaussianModel | Snapshot,
    T_world_base: ArrayLike,
    *,
    box: ArrayLike | None = None,
    names: Sequence[NamedPlace] = (),
    apart: float = _APART,
) -> MapScene:
    """Remove the support of a map and gather what stands on it.

    Args:
        source: the map.
        T_world_base: (4, 4), a frame whose z is up.
        box: (2, 3) corners of the space that is looked at, in that frame [m]; None: 2 m around.
        names: what a scene file calls things.
        apart: objects have more than this between their Gaussians [m].

    Raises:
        InputError: nothing of the map is in the box.
    """
    model = source.model if isinstance(source, Snapshot) else source
    T = np.asarray(T_world_base, dtype=np.float64)
    points = transform_points(inverse(T), model.means.detach().double().numpy())
    low, high = np.array([[-2.0] * 3, [2.0] * 3]) if box is None else np.asarray(box, dtype=np.float64)
    solid = (model.opacities.detach().numpy() >= OPAQUE) & (model.observations.numpy() >= 1)
    used = np.flatnonzero(solid & ((points >= low - ABOVE) & (points <= high)).all(axis=1))
    if not len(used):
        raise InputError(f"has nothing between {low.tolist()} and {high.tolist()}.", field="map", hint="see scene.yaml")
    support = find_support(points[used])
    labels = np.full(len(model), -1, np.int32)
    objects: list[MapObject] = []
    above = used if support is None else used[(support.height(points[used]) > ABOVE) & ~support.inside]
    colors = model.colors.detach().double().numpy()
    for part in clusters(points[above], apart=apart):
        rows = above[part]
        if len(rows) < FEWEST or np.ptp(points[rows], axis=0).max() > LARGEST:
            continue
        labels[rows] = len(objects)
        objects.append(_described(len(objects), rows, points[rows], colors[rows], T))
    named = _with_names(tuple(objects), points, T, names)
    version = source.map_version if isinstance(source, Snapshot) else 0
    return MapScene(model, T, support, named, labels, version)


def _described(number: int, rows: NDArray[np.int64], points: Array, colors: Array, T: Array) -> MapObject:
    import cv2

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
            o = objects[k]
            found[k] = MapObject(o.number, o.rows, o.center, o.size, o.color, place.name, place.aliases)
    return tuple(found)

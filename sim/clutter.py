"""A Gaussian map in a scene: a table, fitted objects, and merged ellipsoids for what is left."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import quat_to_rotation
from splatbot.protocols import Array
from splatbot.segmentation import Fit, Support, clusters, find_support, fit, given_support
from splatbot.sim.maps.ellipsoids import Ellipsoids, merge
from splatbot.sim.scene import Clutter, Scene, SceneObject
from splatbot.sim.solids import rotation_of

_OPAQUE = 0.3  # fainter Gaussians are no surface
_ABOVE = 0.008  # [m] over the table: lower is the table's own noise
_BESIDE = 0.03  # [m] from a thing that may move: what is left of the map there is of the thing
_FEWEST, _LARGEST = 40, 0.35  # Gaussians of an object; [m] across


@dataclass(frozen=True, eq=False)
class MapParts:
    """What a map became.

    Args:
        model: the map, in its own frame.
        objects: table and fitted objects, as a scene has them.
        ellipsoids: the rest.
        notes: each with its geometric error against the map, in words.
        labels: (N,) of the map's Gaussians: -2 left out, -1 ellipsoids, 0 the table, k the k-th fitted object.
    """

    model: GaussianModel
    objects: tuple[SceneObject, ...]
    ellipsoids: Ellipsoids
    notes: tuple[str, ...]
    labels: np.ndarray


def map_parts(model: GaussianModel, clutter: Clutter, base: Array) -> MapParts:
    """Table, objects and ellipsoids of a map.

    Args:
        model: the map.
        clutter: which part of it, and where it is.
        base: (3,) of the robot, near which ellipsoids are small [m].

    Raises:
        InputError: nothing of the map is in the part that is used.
    """
    R, t = rotation_of(clutter.rpy), np.asarray(clutter.at)
    means = model.means.detach().numpy().astype(np.float64) @ R.T + t
    solid = model.opacities.detach().numpy() >= _OPAQUE
    used = np.flatnonzero(solid & ((means >= clutter.low) & (means <= clutter.high)).all(axis=1))
    if not len(used):
        raise InputError(
            f"{clutter.file}: none of {len(means)} Gaussians is between {clutter.low} and {clutter.high}.",
            field="map",
            hint="name another part by low and high, or place the map by at and rpy",
        )
    points, labels = means[used], np.full(len(means), -2, dtype=np.int32)
    labels[used] = -1
    objects: list[SceneObject] = []
    notes: list[str] = []
    support = find_support(points) if clutter.support is None else _given(points, clutter.support)
    if support is not None:
        labels[used[support.inside]] = 0
        objects.append(_table(support))
        notes.append(f"table: {int(support.inside.sum())} Gaussians, RMS {1e3 * support.error:.1f} mm from the plane")
        if clutter.objects:
            _add_objects(points, used, support, clutter, labels, objects, notes)
    left = np.flatnonzero(labels == -1)
    quats, scales = (x.detach().numpy().astype(np.float64)[left] for x in (model.quats, model.scales))
    M = R @ quat_to_rotation(quats) * scales[:, None, :] if len(left) else np.zeros((0, 3, 3))
    weights = np.sort(scales, axis=1)[:, 1:].prod(axis=1) if len(left) else np.zeros(0)
    rest = merge(means[left], M @ M.transpose(0, 2, 1), weights, base, clutter.ellipsoids)
    notes.append(
        f"clutter: {len(left)} Gaussians as {len(rest.centers)} ellipsoids, "
        f"{1e3 * rest.error:.1f} mm from them (95 %: {1e3 * rest.worst:.1f} mm)"
    )
    return MapParts(model, tuple(objects), rest, tuple(notes), labels)


def load_parts(scene: Scene) -> tuple[Scene, MapParts | None]:
    """The scene with its map's objects and degree of colours, and the map's parts; without a map, the scene itself."""
    if scene.map is None:
        return scene, None
    path = Path(scene.map.file)
    model = GaussianModel.load(path if path.is_absolute() else scene.folder / path)
    base = np.asarray(scene.robot.at if scene.robot is not None else (0.0, 0.0, 0.0), dtype=np.float64)
    parts = map_parts(model, scene.map, base)
    read = scene.map.model_copy(update={"harmonics": model.sh_degree})
    return scene.model_copy(update={"objects": (*scene.objects, *parts.objects), "map": read}), parts


def add_ellipsoids(spec: Any, ellipsoids: Ellipsoids) -> list[Any]:
    """A geom for each, in the world itself: 2,000 in a body of their own take twice the time, asleep eight times."""
    geoms = []
    for center, axes, quat in zip(ellipsoids.centers, ellipsoids.axes, ellipsoids.quats, strict=True):
        geom = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, pos=center, size=axes, quat=quat)
        geom.condim, geom.rgba = 1, [0.6, 0.6, 0.65, 1.0]
        geoms.append(geom)
    return geoms


def _given(points: Array, plane: tuple[float, float, float, float]) -> Support:
    length = float(np.linalg.norm(plane[:3]))
    if length < 1e-6 or plane[2] <= 0:
        raise InputError(f"is {list(plane)}.", field="map.support", hint="give n, d with n upwards")
    return given_support(points, np.array(plane[:3]) / length, -plane[3] / length)


def _table(support: Support) -> SceneObject:
    n = support.normal
    roll, pitch = float(np.arctan2(-n[1], n[2])), float(np.arcsin(np.clip(n[0], -1, 1)))
    at = n * support.offset
    values = {"name": "map-table", "shapes": [{"kind": "plane"}], "at": at.tolist(), "rpy": [roll, pitch, 0.0]}
    return SceneObject.model_validate(values)


def _add_objects(
    points: Array,
    used: np.ndarray,
    support: Support,
    clutter: Clutter,
    labels: np.ndarray,
    objects: list[SceneObject],
    notes: list[str],
) -> None:
    above = np.flatnonzero((support.height(points) > _ABOVE) & ~support.inside)
    for rows in clusters(points[above]):
        cluster = points[above[rows]]
        if len(cluster) < _FEWEST or np.ptp(cluster, axis=0).max() > _LARGEST:
            continue
        floor = support.offset / support.normal[2]
        found: Fit = fit(cluster, floor)
        number = len(objects)
        labels[used[above[rows]]] = number
        name = f"map-{found.shape['kind']}-{number}"
        values = {"name": name, "shapes": [found.shape], "at": found.at.tolist(), "movable": clutter.movable}
        objects.append(SceneObject.model_validate(values))
        notes.append(
            f"{name}: {len(cluster)} Gaussians, {1e3 * found.error:.1f} mm from its surface "
            f"(95 %: {1e3 * found.worst:.1f} mm)"
        )
    if clutter.movable:
        _gather_strays(points, used, support, labels)


def _gather_strays(points: Array, used: np.ndarray, support: Support, labels: np.ndarray) -> None:
    """Gives what is beside a thing the thing's label: as clutter, which stays where it is, it would nail it down."""
    here = labels[used]
    loose, fitted = np.flatnonzero((here == -1) & (support.height(points) > 0)), np.flatnonzero(here > 0)
    if not len(fitted):
        return
    for part in np.array_split(loose, max(1, len(loose) * len(fitted) // 1_000_000)):
        away = np.linalg.norm(points[part, None] - points[None, fitted], axis=-1)
        nearest = away.argmin(axis=1)
        near = away[np.arange(len(part)), nearest] < _BESIDE
        labels[used[part[near]]] = here[fitted[nearest[near]]]

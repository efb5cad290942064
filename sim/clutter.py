"""A Gaussian map in a simulated scene: a table, fitted objects, and merged ellipsoids for the rest."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import mujoco
import numpy as np

from splatbot.collision import GaussianCollisionField
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, quat_to_rotation, transform_points
from splatbot.protocols import Array
from splatbot.segmentation import SegmentedMap, Support, fit, segment
from splatbot.segmentation.objects import CONSTANTS as SEGMENTATION
from splatbot.segmentation.objects import solid_rows
from splatbot.sim.maps.ellipsoids import Ellipsoids, merge, surface_points
from splatbot.sim.scene import Clutter, Scene, SceneObject
from splatbot.sim.solids import pose_at, rpy_of


@dataclass(frozen=True)
class ClutterConstants:
    """Constants of twins of mapped tables.

    Args:
        table_thickness: [m] depth below the table top is hardly observed.
        rim: [%] share of the table's Gaussians that may lie beyond its edge on each side.
        stray_distance: [m] distance to a movable object within which remaining Gaussians belong to it.
    """

    table_thickness: float = 0.02
    rim: float = 0.5
    stray_distance: float = 0.03


CONSTANTS = ClutterConstants()


_ON_TABLE = -2  # label of segmentation
REPRESENTED = -3
"""Label of Gaussians that an object of the scene represents; see :class:`splatbot.sim.scene.Clutter`."""


@dataclass(frozen=True, eq=False)
class MapParts:
    """Collision geometry made from a map.

    Args:
        model: the map, in its own frame.
        objects: table and fitted objects, as scene objects.
        ellipsoids: the rest.
        notes: description of each part with its geometric error against the map.
        labels: (N,) of the map's Gaussians: -3 represented by an object of the scene, -2 left out, -1 ellipsoids, 0 the
            table, k the k-th fitted object.
    """

    model: GaussianModel
    objects: tuple[SceneObject, ...]
    ellipsoids: Ellipsoids
    notes: tuple[str, ...]
    labels: np.ndarray


def map_parts(model: GaussianModel, clutter: Clutter, base: Array) -> MapParts:
    """Convert a map to table, objects and ellipsoids.

    Args:
        model: the map.
        clutter: which part of the map is used, and its pose.
        base: (3,) of the robot [m], near which ellipsoids are small.

    Raises:
        InputError: the used part of the map has no Gaussians.
    """
    T_scene_map = pose_at(clutter.at, clutter.rpy)
    R = T_scene_map[:3, :3]
    means = transform_points(T_scene_map, model.means.detach().double().numpy())
    inside = ((means >= clutter.low) & (means <= clutter.high)).all(axis=1)
    represented = np.zeros(len(means), np.bool_)
    for *center, radius in clutter.without:
        represented |= np.linalg.norm(means - center, axis=1) <= radius
    used = np.flatnonzero(solid_rows(model) & inside & ~represented)
    if not len(used):
        raise InputError(
            f"{clutter.file}: none of {len(means)} Gaussians is solid and between {clutter.low} and {clutter.high}.",
            field="map",
            hint="name another part by low and high, or place the map by at and rpy",
        )
    labels = np.full(len(means), -2, dtype=np.int32)
    labels[represented] = REPRESENTED
    labels[used] = -1
    objects: list[SceneObject] = []
    notes: list[str] = []
    plane = None if clutter.support is None else _in_map(clutter.support, T_scene_map)
    scene = segment(model, inverse(T_scene_map), box=[clutter.low, clutter.high], plane=plane)
    if scene.support is not None:
        on = used[scene.labels[used] == _ON_TABLE]
        labels[on] = 0
        objects.append(_table(scene.support, means[on]))
        notes.append(f"table: {len(on)} Gaussians, RMS {1e3 * scene.support.error:.1f} mm from the plane")
        if clutter.objects:
            _add_objects(scene, means, used, clutter, labels, objects, notes)
    left = np.flatnonzero(labels == -1)
    quats, scales = (x.detach().numpy().astype(np.float64)[left] for x in (model.quats, model.scales))
    M = R @ quat_to_rotation(quats) * scales[:, None, :] if len(left) else np.zeros((0, 3, 3))
    weights = np.sort(scales, axis=1)[:, 1:].prod(axis=1) if len(left) else np.zeros(0)
    rest = merge(means[left], M @ M.transpose(0, 2, 1), weights, base, clutter.ellipsoids)
    beyond = 1e3 * np.percentile(_beyond(rest, model, T_scene_map), [50, 95])
    notes.append(
        f"clutter: {len(left)} Gaussians as {len(rest.centers)} ellipsoids, "
        f"{1e3 * rest.error:.1f} mm from them (95 %: {1e3 * rest.worst:.1f} mm), which extend "
        f"{beyond[0]:.1f} mm beyond the collision field (95 %: {beyond[1]:.1f} mm)"
    )
    return MapParts(model, tuple(objects), rest, tuple(notes), labels)


def load_parts(scene: Scene) -> tuple[Scene, MapParts | None]:
    """Load a scene's map; return the scene with the map's objects, and the parts, or None without a map."""
    if scene.map is None:
        return scene, None
    path = Path(scene.map.file)
    model = GaussianModel.load(path if path.is_absolute() else scene.folder / path)
    base = np.asarray(scene.robot.at if scene.robot is not None else (0.0, 0.0, 0.0), dtype=np.float64)
    parts = map_parts(model, scene.map, base)
    read = scene.map.model_copy(update={"harmonics": model.sh_degree})
    return scene.model_copy(update={"objects": (*scene.objects, *parts.objects), "map": read}), parts


def add_ellipsoids(spec: Any, ellipsoids: Ellipsoids) -> list[Any]:
    """Add a geom for each ellipsoid to the world body: in a body of their own, 2,000 take 2 to 8 times the time."""
    geoms = []
    for center, axes, quat in zip(ellipsoids.centers, ellipsoids.axes, ellipsoids.quats, strict=True):
        geom = spec.worldbody.add_geom(type=mujoco.mjtGeom.mjGEOM_ELLIPSOID, pos=center, size=axes, quat=quat)
        geom.condim, geom.rgba = 1, [0.6, 0.6, 0.65, 1.0]
        geoms.append(geom)
    return geoms


def _beyond(ellipsoids: Ellipsoids, model: GaussianModel, T_scene_map: Array) -> Array:
    """Compute by how much (E,) [m] the ellipsoids extend beyond the collision field that a planner uses."""
    if not len(ellipsoids.centers):
        return np.zeros(1)
    points = surface_points(ellipsoids)
    field = GaussianCollisionField(model, min_opacity=SEGMENTATION.min_opacity)
    in_map = transform_points(inverse(T_scene_map), points.reshape(-1, 3))
    clearance = field.clearance(in_map).distance.reshape(points.shape[:2])
    return np.maximum(clearance.max(axis=1), 0.0)


def _in_map(plane: tuple[float, float, float, float], T_scene_map: Array) -> Array:
    """Transform a plane (n, d) of the scene, n · p + d = 0, to the map's frame (4,)."""
    length = float(np.linalg.norm(plane[:3]))
    if length < 1e-6 or plane[2] <= 0:
        raise InputError(f"is {list(plane)}.", field="map.support", hint="give n, d with n upwards")
    normal = np.array(plane[:3]) / length
    return np.append(normal @ T_scene_map[:3, :3], plane[3] / length + normal @ T_scene_map[:3, 3])


def _table(support: Support, on: Array) -> SceneObject:
    """Fit a box of the observed extent; an infinite plane would obstruct an arm beyond the table's edge."""
    n = support.normal
    along = np.cross([0.0, 1.0, 0.0], n)
    along /= np.linalg.norm(along)
    flat = np.stack([along, np.cross(n, along)], axis=1)
    seen = on @ flat
    if len(seen) < SEGMENTATION.min_gaussians:
        roll, pitch = float(np.arctan2(-n[1], n[2])), float(np.arcsin(np.clip(n[0], -1, 1)))
        values = {"shapes": [{"kind": "plane"}], "at": (n * support.offset).tolist(), "rpy": [roll, pitch, 0.0]}
        return SceneObject.model_validate({"name": "map-table", **values})
    yaw = float(np.radians(cv2.minAreaRect(seen.astype(np.float32))[2]))
    turn = np.array([[np.cos(yaw), -np.sin(yaw)], [np.sin(yaw), np.cos(yaw)]])
    low, high = np.percentile(seen @ turn, [CONSTANTS.rim, 100 - CONSTANTS.rim], axis=0)
    axes = flat @ turn
    at = axes @ ((low + high) / 2) + n * (support.offset - CONSTANTS.table_thickness / 2)
    shape = {
        "kind": "box",
        "size": [*np.maximum(high - low, CONSTANTS.table_thickness).tolist(), CONSTANTS.table_thickness],
    }
    rpy = rpy_of(np.c_[axes, n])
    return SceneObject.model_validate({"name": "map-table", "shapes": [shape], "at": at.tolist(), "rpy": rpy})


def _add_objects(
    scene: SegmentedMap,
    means: Array,
    used: np.ndarray,
    clutter: Clutter,
    labels: np.ndarray,
    objects: list[SceneObject],
    notes: list[str],
) -> None:
    for obj in scene.objects:
        rows = obj.rows[labels[obj.rows] != REPRESENTED]
        points = means[rows[scene.solid[rows]]]
        if len(rows) < len(obj.rows) and len(points) < SEGMENTATION.min_gaussians:
            continue  # an object of the scene represents it
        found = fit(points, _floor(scene, points))
        number = len(objects)
        labels[rows] = number
        name = f"map-{found.shape['kind']}-{number}"
        values = {"name": name, "shapes": [found.shape], "at": found.at.tolist(), "movable": clutter.movable}
        objects.append(SceneObject.model_validate(values))
        notes.append(
            f"{name}: {len(points)} Gaussians, {1e3 * found.error:.1f} mm from its surface "
            f"(95 %: {1e3 * found.worst:.1f} mm)"
        )
    if clutter.movable and scene.support is not None:
        _gather_strays(means[used], used, scene.support, labels)


def _floor(scene: SegmentedMap, points: Array) -> float:
    """Return the height of the support plane [m] under the centre of points."""
    under = scene.under(points) or scene.support
    assert under is not None
    x, y = points[:, :2].mean(axis=0)
    return float((under.offset - under.normal[:2] @ [x, y]) / under.normal[2])


def _gather_strays(points: Array, used: np.ndarray, support: Support, labels: np.ndarray) -> None:
    """Label Gaussians near a fitted object as the object's; as fixed clutter they would block its motion."""
    here = labels[used]
    loose, fitted = np.flatnonzero((here == -1) & (support.height(points) > 0)), np.flatnonzero(here > 0)
    if not len(fitted):
        return
    for part in np.array_split(loose, max(1, len(loose) * len(fitted) // 1_000_000)):
        away = np.linalg.norm(points[part, None] - points[None, fitted], axis=-1)
        nearest = away.argmin(axis=1)
        near = away[np.arange(len(part)), nearest] < CONSTANTS.stray_distance
        labels[used[part[near]]] = here[fitted[nearest[near]]]

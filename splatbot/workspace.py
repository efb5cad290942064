"""Workspace of a robot in a map: `scene.yaml` next to a map or in a log's folder, read, written and estimated."""

from __future__ import annotations

import os
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import yaml
from numpy.typing import ArrayLike, NDArray

from splatbot.atomic import atomic_write
from splatbot.errors import FormatError, InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import pose_from_quat, rotation_to_quat, transform_points

Array = NDArray[np.float64]

NAME = "scene.yaml"
MAX_JOINT_DELAY_S = 1.0
MAX_BASE_OFFSET = 100.0
"""Largest move of a base along an axis [m]; larger numbers are probably millimetres."""
MAX_PREFIX = 128
"""Longest prefix of names in TF [characters]."""
_KEYS = (
    "T_world_base",
    "gravity",
    "support_plane",
    "workspace",
    "T_link_camera",
    "camera_link",
    "objects",
    "joint_offsets",
    "offsets_of",
    "joint_delay",
    "joint_names",
    "tf_prefix",
    "base_proposed",
)


@dataclass(frozen=True)
class WorkspaceConstants:
    """Constants of the search for the work surface."""

    ransac_trials: int = 4000
    """Number of sampled planes [1]. One triple in a thousand hits a plane with a tenth of the points; fewer samples
    miss small tables."""
    inlier_distance: float = 0.01
    """Largest distance [m] of an inlier from its plane. A smaller one loses the noisy points of distant surfaces."""
    tilt_exponent: int = 6
    """Exponent [1] of the cosine of a plane's tilt, which weights its inliers. A larger one prefers level planes to
    larger ones."""
    ahead: float = 0.55
    """Distance [m] from the base of a robot to the middle of its workspace, for an arm of the size of a Panda."""
    height: float = 0.8
    """Height [m] of the workspace above the plane."""


CONSTANTS = WorkspaceConstants()
_LEAST_NORMAL = 1e-9  # [m²] of the cross product of two edges, of which collinear points have none


@dataclass(frozen=True, eq=False)
class NamedPlace:
    """Name of an object in the map.

    Args:
        name: name of the object.
        at: (3,) point in or on the object [m, world].
        aliases: other names.
    """

    name: str
    at: Array
    aliases: tuple[str, ...] = ()


@dataclass(frozen=True, eq=False)
class Workspace:
    """Description of the scene in addition to the map. The world frame is the map's, usually its first camera.

    Unknown fields have the value None.

    Args:
        T_world_base: (4, 4) pose of the robot's base, with z up [m].
        gravity: (3,) unit vector downwards in the world.
        support_plane: (4,) = (n, d), the support surface n · p + d = 0 with the upward unit normal n [m].
        box: (2, 3) low and high corners of the workspace in the frame of the base [m].
        T_link_camera: (4, 4) pose of the camera on its link [m].
        camera_link: index of the link that carries the camera; -1 is the last one, 0 the base.
        objects: named objects.
        joint_offsets: (J,) offsets to be added to measured joint positions [rad or m].
        offsets_of: name of the arm that has these offsets, without its hand; empty if unknown.
        joint_delay: time [s] by which the stamps of measured joint positions are later than the motion.
        joint_names: (J,) names of the robot's joints in recordings, if they are not those of its model.
        tf_prefix: prefix of the names of the robot's links in TF, as ``left_``.
        base_proposed: whether the base is a proposal of :func:`fit_workspace`, and not that of a real robot.

    Raises:
        InputError: a value has a wrong shape, is not finite, or is no rigid pose, no unit vector, no prefix or an empty
            box.
    """

    T_world_base: Array | None = None
    gravity: Array | None = None
    support_plane: Array | None = None
    box: Array | None = None
    T_link_camera: Array | None = None
    camera_link: int = -1
    objects: tuple[NamedPlace, ...] = ()
    joint_offsets: Array | None = None
    offsets_of: str = ""
    joint_delay: float = 0.0
    joint_names: tuple[str, ...] = ()
    tf_prefix: str = ""
    base_proposed: bool = False

    def __post_init__(self) -> None:
        _check("T_world_base", self.T_world_base, (4, 4), "a pose")
        _check("gravity", self.gravity, (3,), "three numbers")
        _check("support_plane", self.support_plane, (4,), "a unit normal and an offset")
        _check("workspace", self.box, (2, 3), "two corners")
        for name, direction in (("gravity", self.gravity), ("support_plane", self.support_plane)):
            if direction is not None and abs(float(np.linalg.norm(direction[:3])) - 1.0) > 1e-3:
                raise InputError("is no unit vector.", field=name, hint="divide it by its length")
        if self.box is not None and not (self.box[1] > self.box[0]).all():
            raise InputError("is empty.", field="workspace", hint="give low corners below high ones")
        _check("T_link_camera", self.T_link_camera, (4, 4), "a pose")
        if self.joint_offsets is not None:
            _check("joint_offsets", self.joint_offsets, (self.joint_offsets.size,), "one number for each joint")
        if not isinstance(self.offsets_of, str):
            hint = "give the name of the arm that has the joint_offsets, as panda"
            raise InputError(f"is {self.offsets_of!r}.", field="offsets_of", hint=hint)
        for name, T in (("T_world_base", self.T_world_base), ("T_link_camera", self.T_link_camera)):
            if T is not None and np.abs(T[:3, :3] @ T[:3, :3].T - np.eye(3)).max() > 1e-6:
                raise InputError("is no rigid pose.", field=name, hint="give a rotation and a translation")
        if not abs(self.joint_delay) <= MAX_JOINT_DELAY_S:
            hint = f"give seconds, at most {MAX_JOINT_DELAY_S:g}"
            raise InputError(f"is {self.joint_delay}.", field="joint_delay", hint=hint)
        if not isinstance(self.tf_prefix, str) or self.tf_prefix.startswith("/") or len(self.tf_prefix) > MAX_PREFIX:
            hint = f"give at most {MAX_PREFIX} characters without a leading slash, as left_ or left/"
            raise InputError(f"is {str(self.tf_prefix)[:40]!r}.", field="tf_prefix", hint=hint)
        if not isinstance(self.base_proposed, bool):
            raise InputError(f"is {self.base_proposed!r}.", field="base_proposed", hint="give true or false")
        if not isinstance(self.camera_link, int) or isinstance(self.camera_link, bool):
            raise InputError(
                f"is {self.camera_link!r}.", field="camera_link", hint="give a link's number, -1: the last"
            )

    @classmethod
    def load(cls, path: str | Path) -> Workspace:
        """Load a YAML file.

        Raises:
            FormatError: the file cannot be read, or a field is unknown or invalid.
        """
        try:
            found = yaml.safe_load(Path(path).read_text())
        except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
            raise FormatError(f"cannot be read ({error}).", file=path, hint="write it as YAML") from error
        if not isinstance(found, dict) or set(found) - set(_KEYS):
            unknown = ", ".join(map(str, sorted(set(found) - set(_KEYS)))) if isinstance(found, dict) else "no mapping"
            raise FormatError(f"holds {unknown}.", file=path, field="fields", hint=f"fields: {', '.join(_KEYS)}")
        try:
            return cls(
                T_world_base=_pose(found, "T_world_base"),
                gravity=_array(found.get("gravity"), "gravity"),
                support_plane=_array(found.get("support_plane"), "support_plane"),
                box=_array(found.get("workspace"), "workspace"),
                T_link_camera=_pose(found, "T_link_camera"),
                camera_link=found.get("camera_link", -1),
                objects=_places(found.get("objects")),
                joint_offsets=_array(found.get("joint_offsets"), "joint_offsets"),
                offsets_of=found.get("offsets_of", ""),
                joint_delay=_number(found.get("joint_delay", 0.0), "joint_delay"),
                joint_names=_names(found.get("joint_names", [])),
                tf_prefix=found.get("tf_prefix", ""),
                base_proposed=found.get("base_proposed", False),
            )
        except InputError as error:
            raise FormatError(error.message, file=path, field=error.field, hint=error.hint) from error

    def with_base_moved(self, offset: ArrayLike) -> Workspace:
        """Return the workspace with the base moved by ``offset`` (3,) [m] along its own axes; the box stays in place.

        Raises:
            InputError: the base is unknown, or the offset is not three numbers within 100 m.
        """
        moved = np.asarray(offset, dtype=np.float64)
        _check("base offset", moved, (3,), "three numbers")
        if np.abs(moved).max() > MAX_BASE_OFFSET:
            hint = f"give metres, at most {MAX_BASE_OFFSET:g} along each axis"
            raise InputError(f"is {moved.tolist()}.", field="base offset", hint=hint)
        if self.T_world_base is None:
            hint = "propose one: splatbot info RUN --fit-plane --up X Y Z"
            raise InputError("is not known.", field="T_world_base", hint=hint)
        T = self.T_world_base.copy()
        T[:3, 3] += T[:3, :3] @ moved
        box = None if self.box is None else self.box - moved
        return replace(self, T_world_base=T, box=box, base_proposed=False)

    def save(self, path: str | Path) -> None:
        """Write a YAML file; unknown fields are omitted."""
        document: dict[str, Any] = {}
        for key, T in (("T_world_base", self.T_world_base), ("T_link_camera", self.T_link_camera)):
            if T is not None:
                quat = rotation_to_quat(T[:3, :3])
                document[key] = {"translation": _plain(T[:3, 3]), "quaternion_wxyz": _plain(quat, 9)}
        if self.T_link_camera is not None:
            document["camera_link"] = self.camera_link
        for key, value in zip(_KEYS[1:4], (self.gravity, self.support_plane, self.box), strict=True):
            if value is not None:
                document[key] = _plain(value, 9)
        if self.joint_offsets is not None:
            document["joint_offsets"] = _plain(self.joint_offsets)
        if self.offsets_of:
            document["offsets_of"] = self.offsets_of
        if self.joint_delay:
            document["joint_delay"] = round(self.joint_delay, 6)
        if self.joint_names:
            document["joint_names"] = list(self.joint_names)
        if self.tf_prefix:
            document["tf_prefix"] = self.tf_prefix
        if self.base_proposed:
            document["base_proposed"] = True
        if self.objects:
            document["objects"] = [
                {"name": o.name, "at": _plain(o.at)} | ({"aliases": list(o.aliases)} if o.aliases else {})
                for o in self.objects
            ]
        with atomic_write(Path(path)) as file:
            file.write(yaml.safe_dump(document, sort_keys=False, default_flow_style=None).encode())


def same_offsets(one: ArrayLike, other: ArrayLike) -> bool:
    """Return whether two arms have the same joint offsets (J,) [rad or m], to the digits of a ``scene.yaml``."""
    a, b = np.asarray(one, np.float64), np.asarray(other, np.float64)
    return a.shape == b.shape and bool(np.abs(a - b).max(initial=0.0) <= 1e-6)


def find_workspace(*places: str | Path | None) -> Workspace | None:
    """Return the first ``scene.yaml`` in the given folders or next to the given files, or None.

    A place may be the address of a log: options after a question mark are left out.

    Raises:
        FormatError: the file is damaged.
    """
    for place in places:
        if place is None:
            continue
        known = os.path.exists(place)  # noqa: PTH110 - Path.exists() raises if the options are too long for a name
        path = Path(place if known else str(place).partition("?")[0])
        file = (path.parent if path.suffix and not path.is_dir() else path) / NAME
        if file.is_file():
            return Workspace.load(file)
    return None


def fit_workspace(model: GaussianModel, *, up: ArrayLike = (0.0, -1.0, 0.0), seed: int = 0) -> Workspace:
    """Estimate the support plane below the first camera, and propose a base and a workspace on it.

    RANSAC (Fischler and Bolles 1981) maximizes ``inliers · (n · up)⁶`` over planes of normal n; least squares refine
    the plane. The base is 55 cm from the middle of the plane's inliers on the camera's side, with x towards the middle.
    These are estimates for correction by hand.

    Args:
        model: a map whose world frame is its first camera.
        up: (3,) approximate upward direction: -y for a camera that looks ahead, -z for one that looks straight down.
        seed: seed of the RANSAC samples.

    Raises:
        InputError: the map has fewer than 100 Gaussians, ``up`` is no direction, or no plane has 5 % of the Gaussians.
    """
    points = model.means.double().numpy()
    upward = np.asarray(up, dtype=np.float64)
    if upward.shape != (3,) or not np.isfinite(upward).all() or not upward.any():
        raise InputError(f"is {upward.tolist()}.", field="up", hint="give three numbers, as 0 -1 0")
    upward = upward / np.linalg.norm(upward)
    if len(points) < 100:
        raise InputError(f"has {len(points)} Gaussians.", field="map", hint="map a log with a table or a floor in view")
    rng = np.random.default_rng(seed)
    some = points[rng.choice(len(points), min(len(points), 4000), replace=False)]
    best, best_score, count = np.zeros(4), 0.0, 0
    trios = some[rng.integers(0, len(some), (CONSTANTS.ransac_trials, 3))]
    for some_trios in np.array_split(trios, max(1, len(trios) // 250)):  # 8 MB of distances at a time
        normals = np.cross(some_trios[:, 1] - some_trios[:, 0], some_trios[:, 2] - some_trios[:, 0])
        planes = _planes(normals, some_trios[:, 0], upward)
        planes = planes[planes[:, 3] > 0.0]  # below the first camera
        inliers = (np.abs(planes[:, :3] @ some.T + planes[:, 3:]) < CONSTANTS.inlier_distance).sum(axis=1)
        scores = inliers * (planes[:, :3] @ upward) ** CONSTANTS.tilt_exponent
        if len(scores) and scores.max() > best_score:
            k = int(scores.argmax())
            best, best_score, count = planes[k], float(scores[k]), int(inliers[k])
    if count < len(some) / 20:
        raise InputError("has no upward surface.", field="map", hint="write scene.yaml by hand")
    for _ in range(5):  # least squares on the inliers
        on = points[np.abs(points @ best[:3] + best[3]) < CONSTANTS.inlier_distance]
        middle = on.mean(axis=0)
        best = _planes(np.linalg.svd(on - middle, full_matrices=False)[2][2:], middle[None], upward)[0]
    return workspace_on(best, points)


def workspace_on(plane: Array, points: Array) -> Workspace:
    """Propose a base and a workspace on a plane (4,), as (n, d) with n upwards, from the points (N, 3) on it [m].

    Raises:
        InputError: no point is on the plane.
    """
    on = points[np.abs(points @ plane[:3] + plane[3]) < CONSTANTS.inlier_distance]
    if not len(on):
        raise InputError("has no points on it.", field="plane", hint="take a plane of the map")
    return _around(plane, on)


def _planes(normals: Array, points: Array, up: Array) -> Array:
    """Return the planes (M, 4) through points (N, 3) with normals (N, 3), turned upwards; zero normals have none."""
    lengths = np.linalg.norm(normals, axis=1)
    firm = lengths > _LEAST_NORMAL
    n = normals[firm] / lengths[firm, None]
    n *= np.where(n @ up < 0, -1.0, 1.0)[:, None]
    return np.column_stack([n, -(n * points[firm]).sum(axis=1)])


def _around(plane: Array, on: Array) -> Workspace:
    up = plane[:3]
    middle = np.median(on, axis=0)
    middle = middle - (middle @ up + plane[3]) * up
    forward = middle - (middle @ up) * up  # from below the first camera to the middle
    length = float(np.linalg.norm(forward))
    forward = forward / length if length > 1e-6 else np.linalg.svd(up[None])[2][1]
    T = np.eye(4)
    T[:3, :3] = np.stack([forward, np.cross(up, forward), up], axis=1)
    T[:3, 3] = middle - CONSTANTS.ahead * forward
    local = transform_points(np.linalg.inv(T), on)
    low, high = np.percentile(local, [1, 99], axis=0)
    box = np.array([[low[0], low[1], 0.0], [high[0], high[1], CONSTANTS.height]])
    return Workspace(T, -up, plane, box, base_proposed=True)


def _check(name: str, value: Array | None, shape: tuple[int, ...], meaning: str) -> None:
    if value is not None and (value.shape != shape or not np.isfinite(value).all()):
        raise InputError(f"is {value.shape}, or not finite.", field=name, hint=f"give {meaning}, {shape}")


def _pose(found: dict[str, Any], key: str) -> Array | None:
    value = found.get(key)
    if value is None:
        return None
    if not isinstance(value, dict) or set(value) != {"translation", "quaternion_wxyz"}:
        raise InputError("is no pose.", field=key, hint="give translation and quaternion_wxyz")
    translation, quat = _array(value["translation"], "translation"), _array(value["quaternion_wxyz"], "quaternion")
    if translation is None or quat is None or translation.shape != (3,) or quat.shape != (4,):
        raise InputError("has a wrong shape.", field=key, hint="give 3 and 4 numbers")
    try:
        return pose_from_quat(translation, quat)
    except ValueError as error:
        raise InputError(f"{error}.", field="quaternion_wxyz", hint="no rotation is 1 0 0 0") from error


def _places(value: Any) -> tuple[NamedPlace, ...]:
    if value is None:
        return ()
    hint = "list objects as - {name: cup, at: [x, y, z], aliases: [mug]}"
    if not isinstance(value, list) or not all(isinstance(entry, dict) for entry in value):
        raise InputError("is no list of objects.", field="objects", hint=hint)
    found = []
    for entry in value:
        at, aliases = _array(entry.get("at"), "objects: at"), entry.get("aliases", [])
        words = [entry.get("name"), *(aliases if isinstance(aliases, list) else [None])]
        if set(entry) - {"name", "at", "aliases"} or not all(isinstance(word, str) and word for word in words):
            raise InputError(f"has {entry}.", field="objects", hint=hint)
        if at is None or at.shape != (3,) or not np.isfinite(at).all():
            raise InputError(f"{entry['name']} has no valid position.", field="objects", hint=hint)
        found.append(NamedPlace(entry["name"], at, tuple(words[1:])))
    return tuple(found)


def _number(value: Any, name: str) -> float:
    if not isinstance(value, int | float) or isinstance(value, bool):
        raise InputError(f"is {value!r}.", field=name, hint="give a number")
    return float(value)


def _names(value: Any) -> tuple[str, ...]:
    if not isinstance(value, list) or not all(isinstance(name, str) for name in value):
        raise InputError("is no list of names.", field="joint_names", hint="list the names in the robot's order")
    return tuple(value)


def _array(value: Any, name: str) -> Array | None:
    if value is None:
        return None
    try:
        return np.array(value, dtype=np.float64)
    except (TypeError, ValueError) as error:
        raise InputError(f"holds a value that is no number ({error}).", field=name, hint="give numbers") from error


def _plain(values: Array, digits: int = 6) -> Any:
    return np.round(values, digits).tolist()

"""A simulated run of the twin as an interactive page."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from splatbot.protocols import Array
from splatbot.report.moving_page import MAP_IN_COLORS, bytes_of, css, evenly_spaced, moving_page, packed
from splatbot.sim.clutter import REPRESENTED
from splatbot.sim.contact_monitor import FAR
from splatbot.sim.recording import TwinRecording
from splatbot.sim.solids import rotation_of
from splatbot.sim.twin import TwinResult
from splatbot.sim.world import MAP_GROUP, World


@dataclass(frozen=True)
class TwinPageConstants:
    """Constants of the page of a run.

    Args:
        max_points: points of the map.
        points_per_robot_geom: points of a geom of the robot.
        points_per_object_geom: points of a geom of an object.
        crop_radius: [m] radius of the map around the robot that is shown.
        floor: [m] half-extent of planes.
        point_size: [m] size of a point.
        distance: distance of the camera, relative to the extent of the motion.
        min_distance: [m] least distance of the camera.
        yaw: [rad] direction of the view around the z axis; at 4.9 the arm reaches to the right.
    """

    max_points: int = 20_000
    points_per_robot_geom: int = 300
    points_per_object_geom: int = 400
    crop_radius: float = 1.6
    floor: float = 0.8
    point_size: float = 0.006
    distance: float = 1.5
    min_distance: float = 1.2
    yaw: float = 4.9


CONSTANTS = TwinPageConstants()
_ROBOT, _PATH, _CONTACT, _GRIP = (0.75, 0.76, 0.79), (0.2, 0.75, 0.85), (1.0, 0.24, 0.24), (0.65, 0.35, 0.95)
_RISE = (0.95, 0.5, 0.1)


def twin_html(recording: TwinRecording, result: TwinResult) -> str:
    """Return the page of a run of the twin; see :func:`recording_html`."""
    return recording_html(recording, title=result.scene, facts=_facts(result))


def recording_html(recording: TwinRecording, *, title: str, facts: str, target: str = "") -> str:
    """Return the page: robot, objects and map as points, contacts, and curves over time.

    The curves are the clearance of the arm, and the height by which the target rose.

    Args:
        recording: of the run.
        title: of the page.
        facts: results of the run, one line.
        target: name of the object that is the completed surface of a target in a map, or "".
    """
    world = recording.world
    own, normals, tints, body, points, colors = _clouds(world)
    path = _tool_path(recording)
    low, high = _extent(recording, path, body)
    shown, shades = _map_points(world)
    document = {
        "points": packed(np.concatenate([shown, points]), np.float32),
        "colors": packed(bytes_of(np.concatenate([shades, colors])), np.uint8),
        "own": packed(own, np.float32),
        "normals": packed(np.rint(127 * normals), np.int8),
        "tints": packed(bytes_of(tints), np.uint8),
        "path": packed(path, np.float32),
        "pathColor": _bytes(_PATH),
        "body": packed(body, np.uint16),
        "bodies": int(world.model.nbody),
        "poses": packed(recording.poses, np.float32),
        "soft": packed(recording.soft, np.float32),
        "contacts": _rounded(recording.contacts),
        "grips": _rounded(recording.grips),
        "contactColor": _bytes(_CONTACT),
        "gripColor": _bytes(_GRIP),
        "rises": np.round(recording.rise(target), 5).tolist() if target else [],
        "riseColor": css(_RISE),
        "clearances": np.round(recording.clearances, 5).tolist(),
        "clearanceName": _clearance_name(world),
        "far": FAR,
        "times": np.round(recording.times, 4).tolist(),
        "middle": ((low + high) / 2).round(3).tolist(),
        "distance": round(max(CONSTANTS.min_distance, CONSTANTS.distance * float(np.linalg.norm(high - low))), 3),
        "yaw": CONSTANTS.yaw,
        "size": CONSTANTS.point_size,
    }
    return moving_page(title, facts, document, "twin_view.js", legend=_legend(recording, target), curve=True)


def _clearance_name(world: World) -> str:
    """Name the clearance that a recording has at each time: of the whole robot with its hand."""
    has_hand = world.robot is not None and world.robot.gripper is not None
    return "clearance of arm and hand" if has_hand else "clearance of the arm"


def _rounded(contacts: Sequence[Sequence[Sequence[float]]]) -> list[list[list[float]]]:
    return [[[round(value, 4) for value in contact] for contact in found] for found in contacts]


def _bytes(color: Sequence[float]) -> list[int]:
    return [round(255 * part) for part in color]


def _legend(recording: TwinRecording, target: str) -> list[tuple[str, str]]:
    """Return the name and the CSS colour of each part that the page draws."""
    world = recording.world
    rows = [] if world.parts is None else [MAP_IN_COLORS]
    if world.robot is not None:
        rows.append(("arm and hand: their collision shapes, larger than the real ones", css(_ROBOT)))
        rows.append(("path of the tool", css(_PATH)))
    for obj in world.scene.objects:
        if obj.movable or obj.path:
            rows.append((f"{obj.name}: its completed surface" if obj.name == target else obj.name, css(obj.color)))
    if any(recording.contacts):
        rows.append(("contact of the arm; in the curve its time", css(_CONTACT)))
    if any(recording.grips):
        rows.append(("contact of the hand with the target, as expected", css(_GRIP)))
    rows.append((f"{_clearance_name(world)}, in the curve", "var(--curve)"))
    if target:
        rows.append(("rise of the target, in the curve", css(_RISE)))
    return rows


def _extent(recording: TwinRecording, path: Array, body: np.ndarray) -> tuple[Array, Array]:
    """Return the lowest and highest coordinates (3,) [m] of the base, of the tool's path and of the robot's bodies.

    Without a robot, the moving bodies ``body`` (P,) count.
    """
    of_robot = recording.world.of_robot
    bodies = recording.world.model.geom_bodyid[of_robot] if of_robot.any() else body.astype(np.int64)
    places = recording.poses[:, np.unique(bodies), :, 3].reshape(-1, 3)
    moving = np.concatenate([path, places, np.zeros((1, 3))])
    return moving.min(axis=0), moving.max(axis=0)


def _tool_path(recording: TwinRecording) -> Array:
    """Return the positions (T, 3) of the tool over time [m], (0, 3) without a robot."""
    if recording.world.robot is None:
        return np.zeros((0, 3))
    site = recording.world.model.site("tcp")
    poses = recording.poses[:, int(site.bodyid[0])]
    return np.asarray(poses[:, :, :3] @ site.pos + poses[:, :, 3])


def _facts(result: TwinResult) -> str:
    contacts = ", ".join(sorted({contact.other for contact in result.contacts})) or "none"
    found = [
        f"simulated: {result.duration:.2f} s",
        f"contacts: {contacts}",
        f"minimum clearance {1e3 * result.clearance.value:.1f} mm",
    ]
    if result.tracking is not None:
        found.append(f"maximum tool error {1e3 * result.tracking.tcp:.2f} mm")
    if result.dropped:
        found.append(f"fell: {', '.join(result.dropped)}")
    return "; ".join((*found, *result.warnings))


def _clouds(world: World) -> tuple[Array, Array, Array, np.ndarray, Array, Array]:
    """Sample points (P, 3) on moving bodies with normals, colours and bodies, and points and colours of fixed ones.

    Fitted objects of a map are represented by its Gaussians unless they move.
    """
    m, fixed = world.model, np.asarray(world.model.body_weldid) == 0
    moving: list[tuple[Array, Array, Array, np.ndarray]] = []
    still: list[tuple[Array, Array]] = []
    for geom in range(m.ngeom):
        number = int(m.geom_bodyid[geom])
        if int(m.geom_group[geom]) == MAP_GROUP and fixed[number]:
            continue
        points = surface_points(
            m, geom, CONSTANTS.points_per_robot_geom if world.of_robot[geom] else CONSTANTS.points_per_object_geom
        )
        R = np.zeros(9)
        mujoco.mju_quat2Mat(R, m.geom_quat[geom])
        normals = _outward(m, geom, points) @ R.reshape(3, 3).T
        points = points @ R.reshape(3, 3).T + m.geom_pos[geom]
        color = np.tile(_ROBOT if world.of_robot[geom] else m.geom_rgba[geom, :3], (len(points), 1))
        if fixed[number] and not world.of_robot[geom]:
            mujoco.mju_quat2Mat(R, m.body_quat[number])
            still.append((points @ R.reshape(3, 3).T + m.body_pos[number], color))
        else:
            moving.append((points, normals, color, np.full(len(points), number)))
    none = np.zeros((0, 3))
    own, normals, tints, bodies = (
        np.concatenate(part) for part in zip((none, none, none, np.zeros(0)), *moving, strict=True)
    )
    points, colors = (np.concatenate(part) for part in zip((none, none), *still, strict=True))
    return own, normals, tints, bodies, points, colors


def _outward(m: Any, geom: int, points: Array) -> Array:
    """Return unit vectors (P, 3) from the middle of a geom to its points, from the axis of a capsule or cylinder."""
    types = mujoco.mjtGeom
    away = points.copy()
    if int(m.geom_type[geom]) in (int(types.mjGEOM_CAPSULE), int(types.mjGEOM_CYLINDER)):
        away[:, 2] -= np.clip(away[:, 2], -m.geom_size[geom, 1], m.geom_size[geom, 1])
    return np.asarray(away / np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9))


def _map_points(world: World) -> tuple[Array, Array]:
    """Return the fixed Gaussians (P, 3) of the map around the robot, and their colours (P, 3)."""
    if world.parts is None or world.scene.map is None:
        return np.zeros((0, 3)), np.zeros((0, 3))
    model, labels = world.parts.model, world.parts.labels
    means = model.means.double().numpy() @ rotation_of(world.scene.map.rpy).T + world.scene.map.at
    loose = [label for label, obj in enumerate(world.parts.objects) if obj.movable]
    rows = np.flatnonzero((np.abs(means).max(axis=1) < CONSTANTS.crop_radius) & ~np.isin(labels, [*loose, REPRESENTED]))
    rows = rows[evenly_spaced(len(rows), CONSTANTS.max_points)]
    return means[rows], model.colors.double().numpy()[rows]


def surface_points(m: Any, geom: int, count: int) -> Array:
    """Sample about ``count`` points on a geom's surface (P, 3) [m] in its own frame, along rays from its centre."""
    kind, size = int(m.geom_type[geom]), np.asarray(m.geom_size[geom])
    types = mujoco.mjtGeom
    if kind == int(types.mjGEOM_PLANE):
        side = np.linspace(-CONSTANTS.floor, CONSTANTS.floor, int(np.sqrt(4 * count)))
        x, y = (part.ravel() for part in np.meshgrid(side, side))
        return np.stack([x, y, np.zeros_like(x)], axis=1)
    if kind == int(types.mjGEOM_MESH):
        number = int(m.geom_dataid[geom])
        first, vertices = int(m.mesh_vertadr[number]), int(m.mesh_vertnum[number])
        return np.array(m.mesh_vert[first : first + vertices][evenly_spaced(vertices, count)], dtype=np.float64)
    rays = _directions(count)
    across, along = np.hypot(rays[:, 0], rays[:, 1]), np.abs(rays[:, 2])
    with np.errstate(divide="ignore"):
        if kind == int(types.mjGEOM_SPHERE):
            reach = np.full(count, size[0])
        elif kind == int(types.mjGEOM_ELLIPSOID):
            reach = 1.0 / np.linalg.norm(rays / size, axis=1)
        elif kind == int(types.mjGEOM_BOX):
            reach = (size / np.abs(rays)).min(axis=1)
        elif kind == int(types.mjGEOM_CYLINDER):
            reach = np.minimum(size[0] / across, size[1] / along)
        else:  # a capsule: its side, or the spherical cap
            side = size[0] / across
            ball = size[1] * along + np.sqrt(np.maximum(size[0] ** 2 - (size[1] * across) ** 2, 0.0))
            reach = np.where(side * along <= size[1], side, ball)
    return np.asarray(rays * reach[:, None])


def _directions(count: int) -> Array:
    """Return unit vectors (N, 3), evenly spread (Fibonacci lattice)."""
    i = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * i / count, np.pi * (1.0 + np.sqrt(5.0)) * i
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)

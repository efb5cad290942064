"""A run of the twin as a page that is turned, played, stepped and scrubbed."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from splatbot.protocols import Array
from splatbot.report.moving_page import bytes_of, moving_page, packed, thinned
from splatbot.sim.contact_monitor import FAR
from splatbot.sim.recording import TwinRecording
from splatbot.sim.solids import rotation_of
from splatbot.sim.twin import TwinResult
from splatbot.sim.world import MAP_GROUP, World

_MOST_POINTS = 20_000  # of the map
_ON_GEOM, _ON_THING = 300, 400  # points on a geom of the arm, and of another body
_NEAR = 1.6  # [m] around the robot that is shown of a map
_FLOOR = 0.8  # [m] to each side that is shown of a plane
_SIZE = 0.006  # [m] of a point


def twin_html(recording: TwinRecording, result: TwinResult) -> str:
    """The page: robot, things and map as points, places where the arm touches, and its room as a curve over time.

    Args:
        recording: of the run.
        result: what came of it.
    """
    world = recording.world
    own, tints, body, points, colors = _clouds(world)
    shown, shades = _map_points(world)
    document = {
        "points": packed(np.concatenate([shown, points]), np.float32),
        "colors": packed(bytes_of(np.concatenate([shades, colors])), np.uint8),
        "own": packed(own, np.float32),
        "tints": packed(bytes_of(tints), np.uint8),
        "body": packed(body, np.uint16),
        "bodies": int(world.model.nbody),
        "poses": packed(recording.poses, np.float32),
        "soft": packed(recording.soft, np.float32),
        "touches": [[[round(v, 4) for v in touch] for touch in found] for found in recording.touches],
        "rooms": np.round(recording.rooms, 5).tolist(),
        "far": FAR,
        "times": np.round(recording.times, 4).tolist(),
        "middle": [0.35, 0.0, 0.25],
        "distance": 2.2,
        "size": _SIZE,
    }
    return moving_page(result.scene, _facts(result), document, "twin_view.js", curve=True)


def _facts(result: TwinResult) -> str:
    touched = ", ".join(sorted({touch.other for touch in result.touches})) or "nothing"
    found = [f"{result.duration:.2f} s", f"touched: {touched}", f"least room {1e3 * result.near.room:.1f} mm"]
    if result.tracking is not None:
        found.append(f"tool {1e3 * result.tracking.tcp:.2f} mm off at most")
    if result.dropped:
        found.append(f"fell: {', '.join(result.dropped)}")
    return "; ".join((*found, *result.warnings))


def _clouds(world: World) -> tuple[Array, Array, np.ndarray, Array, Array]:
    """Points (P, 3) on the geoms of bodies, their colours and bodies (P,); and points and colours of what stands still.

    Fitted objects of a map are shown by its Gaussians unless they move.
    """
    m, fixed = world.model, np.asarray(world.model.body_weldid) == 0
    moving: list[tuple[Array, Array, np.ndarray]] = []
    still: list[tuple[Array, Array]] = []
    for geom in range(m.ngeom):
        number = int(m.geom_bodyid[geom])
        if int(m.geom_group[geom]) == MAP_GROUP and fixed[number]:
            continue
        points = surface_points(m, geom, _ON_GEOM if world.of_robot[geom] else _ON_THING)
        R = np.zeros(9)
        mujoco.mju_quat2Mat(R, m.geom_quat[geom])
        points = points @ R.reshape(3, 3).T + m.geom_pos[geom]
        color = np.tile(m.geom_rgba[geom, :3], (len(points), 1))
        if fixed[number] and not world.of_robot[geom]:
            mujoco.mju_quat2Mat(R, m.body_quat[number])
            still.append((points @ R.reshape(3, 3).T + m.body_pos[number], color))
        else:
            moving.append((points, color, np.full(len(points), number)))
    none = np.zeros((0, 3))
    own, tints, bodies = (np.concatenate(part) for part in zip((none, none, np.zeros(0)), *moving, strict=True))
    points, colors = (np.concatenate(part) for part in zip((none, none), *still, strict=True))
    return own, tints, bodies, points, colors


def _map_points(world: World) -> tuple[Array, Array]:
    """Gaussians (P, 3) of the map that stay where they are, around the robot, and their colours (P, 3)."""
    if world.parts is None or world.scene.map is None:
        return np.zeros((0, 3)), np.zeros((0, 3))
    model, labels = world.parts.model, world.parts.labels
    means = model.means.double().numpy() @ rotation_of(world.scene.map.rpy).T + world.scene.map.at
    loose = [label for label, thing in enumerate(world.parts.objects) if thing.movable]
    rows = np.flatnonzero((np.abs(means).max(axis=1) < _NEAR) & ~np.isin(labels, loose))
    rows = rows[thinned(len(rows), _MOST_POINTS)]
    return means[rows], model.colors.double().numpy()[rows]


def surface_points(m: Any, geom: int, count: int) -> Array:
    """About ``count`` points on a geom's surface (P, 3) [m], in its own frame: along rays from its middle."""
    kind, size = int(m.geom_type[geom]), np.asarray(m.geom_size[geom])
    types = mujoco.mjtGeom
    if kind == int(types.mjGEOM_PLANE):
        side = np.linspace(-_FLOOR, _FLOOR, int(np.sqrt(4 * count)))
        x, y = (part.ravel() for part in np.meshgrid(side, side))
        return np.stack([x, y, np.zeros_like(x)], axis=1)
    if kind == int(types.mjGEOM_MESH):
        number = int(m.geom_dataid[geom])
        first, many = int(m.mesh_vertadr[number]), int(m.mesh_vertnum[number])
        return np.array(m.mesh_vert[first : first + many][thinned(many, count)], dtype=np.float64)
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
        else:  # a capsule: its side, or the ball at the end
            side = size[0] / across
            ball = size[1] * along + np.sqrt(np.maximum(size[0] ** 2 - (size[1] * across) ** 2, 0.0))
            reach = np.where(side * along <= size[1], side, ball)
    return np.asarray(rays * reach[:, None])


def _directions(count: int) -> Array:
    """Unit vectors (N, 3), evenly spread (Fibonacci's lattice)."""
    i = np.arange(count) + 0.5
    z, turn = 1.0 - 2.0 * i / count, np.pi * (1.0 + np.sqrt(5.0)) * i
    r = np.sqrt(1.0 - z * z)
    return np.stack([r * np.cos(turn), r * np.sin(turn), z], axis=1)

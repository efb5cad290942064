"""A planned trajectory in the map, as an image and as an interactive page."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import product

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, look_at, transform_points
from splatbot.planning import JointTrajectory
from splatbot.planning.closest import ClosestApproach
from splatbot.planning.timing import clearance_text
from splatbot.protocols import Array
from splatbot.rasterize.views import to_png
from splatbot.report.annotations import Color, over_legend, with_legend, with_ring, with_scale
from splatbot.report.moving_page import MAP_IN_COLORS, bytes_of, evenly_spaced, moving_page, packed
from splatbot.report.robot_drawing import DrawnPart, draw_robot, map_view, sphere_parts
from splatbot.report.sphere_gaussians import sphere_gaussians


@dataclass(frozen=True)
class PlanPageConstants:
    """Constants of the page of a plan.

    Args:
        max_points: largest number of points of the map that are shown.
        crop_radius: [m] radius of the map around the base that is shown.
        frames: postures of the animation.
        shown_solids: [m] radius around a collision in which obstacles beyond the map are drawn.
        visible_depth: [m] depth behind the drawn surfaces at which an obstacle still counts as seen.
        filled: share of the image that the motion fills, seen from a given place.
        around_tool: [m] half edge of the cubes around the path of the tool that are shown then.
        end_opacity: 0..1, of the arm at the start and at the goal.
        shell_opacity: 0..1, of the certified spheres around the arm.
    """

    max_points: int = 40_000
    crop_radius: float = 1.6
    frames: int = 80
    shown_solids: float = 0.3
    visible_depth: float = 0.01
    filled: float = 0.92
    around_tool: float = 0.15
    end_opacity: float = 0.4
    shell_opacity: float = 0.35


CONSTANTS = PlanPageConstants()


_START, _END = (0.15, 0.45, 0.9), (0.95, 0.5, 0.1)  # tints of the ends
_START_SHADE, _END_SHADE = (0.49, 0.67, 0.94), (0.97, 0.7, 0.46)  # as the shaded arms look
_FROM = np.array([-1.3, 1.3, 1.0])  # direction from the middle of the motion to the camera, in the base frame
_PAGE_LEGEND = (
    MAP_IN_COLORS,
    ("arm, or its certified spheres", "linear-gradient(90deg, #b9bcc4, #5d6066)"),
    ("path of the tool", "rgb(240, 120, 30)"),
)
_SHELL = (0.45, 0.9, 0.4)
_NEAREST, _TOOL, _SOLID = (1.0, 0.15, 0.2), (0.2, 0.9, 0.95), (0.65, 0.3, 0.95)


def plan_html(
    model: GaussianModel,
    arm: RobotSpheres,
    field: GaussianCollisionField,
    trajectory: JointTrajectory,
    parts: Sequence[DrawnPart],
    fk: Callable[[Array], Array],
    *,
    title: str,
) -> str:
    """Return the page: the map's Gaussians as points, the arm as meshes or certified spheres, and a slider for time.

    Args:
        model: the map.
        arm: collision spheres of the robot with the pose of its base.
        field: collision field of the map.
        trajectory: the planned trajectory.
        parts: appearance of the robot; few triangles let the page move smoothly.
        fk: returns the poses T_base_link (K, L, 4, 4) of its links at joint positions (K, J).
        title: heading.
    """
    times = np.linspace(0.0, trajectory.duration, CONSTANTS.frames)
    q = trajectory.at(times).position
    T_base_world = inverse(arm.T_world_base)  # the page's up direction is the z axis of the base
    points, colors = _nearby(model, T_base_world)
    centers = transform_points(T_base_world, arm.centers(q).reshape(-1, 3))
    last = int(np.flatnonzero(arm.spheres.link == arm.spheres.link.max())[-1])
    tool = centers.reshape(CONSTANTS.frames, -1, 3)[:, last]
    clearances = np.minimum(arm.clearance(field, q, cut=0.5).distance, 0.5)
    links = fk(q)
    middle = np.median(points, axis=0) if len(points) else np.zeros(3)
    document = {
        "points": packed(points, np.float32),
        "colors": packed(colors, np.uint8),
        "spheres": packed(centers, np.float32),
        "radii": arm.spheres.radii.round(4).tolist(),
        "tool": packed(tool, np.float32),
        "corners": packed(np.concatenate([part.triangles.reshape(-1, 9) for part in parts]), np.float32),
        "link": packed(np.repeat([part.link for part in parts], [len(part.triangles) for part in parts]), np.uint16),
        "shades": packed(bytes_of(np.concatenate([np.tile(p.color, (len(p.triangles), 1)) for p in parts])), np.uint8),
        "poses": packed(links[:, :, :3], np.float32),
        "links": int(links.shape[1]),
        "times": times.round(4).tolist(),
        "clearances": clearances.round(4).tolist(),
        "middle": middle.round(3).tolist(),
        "distance": 2.2,
        "yaw": 3.6,
        "size": 0.006,
    }
    c = trajectory.certificate
    facts = (
        f"{trajectory.duration:.2f} s; {'certified' if c.certified else 'NOT certified'}, clearance "
        f"{clearance_text(c)}; map version {c.map_version}"
    )
    return moving_page(title, facts, document, "plan_view.js", legend=_PAGE_LEGEND, toggle="certified spheres")


def plan_png(
    model: GaussianModel,
    arm: RobotSpheres,
    trajectory: JointTrajectory,
    parts: Sequence[DrawnPart],
    fk: Callable[[Array], Array],
    T_link_tcp: Array,
    *,
    nearest: ClosestApproach | None = None,
    seen_from: Array | None = None,
    width: int = 1280,
) -> bytes:
    """Render the map with the arm where it is nearest to the map, and transparent at the start and at the goal.

    The camera shows the whole motion. Dots show the path of the tool, and a ring the nearest point of the map. A green
    shell encloses the nearest link: its certified spheres, larger by the margin. It does not touch the map.

    Args:
        model: the map.
        arm: collision spheres of the robot with the pose of its base.
        trajectory: the planned trajectory.
        parts: appearance of the robot.
        fk: returns the poses T_base_link (K, L, 4, 4) of its links at joint positions (K, J).
        T_link_tcp: (4, 4) pose of the tool on the last link [m].
        nearest: the moment at which the arm is nearest to the map. If None, it is not drawn.
        seen_from: (3,) place of the camera [m, base]. If None, it is above the side of the base.
        width: of the image [px]; the height is 3/4 of it.

    Raises:
        InputError: the camera is within the motion.
    """
    near = _within(model, inverse(arm.T_world_base))
    moments = trajectory.at(np.linspace(0.0, trajectory.duration, CONSTANTS.frames)).position
    tool = (arm.T_world_base @ fk(moments)[:, -1] @ T_link_tcp)[:, :3, 3]
    camera, T_world_camera, away = (
        _framed(arm, moments, width) if seen_from is None else framed_from(seen_from, arm, moments, tool, width)
    )
    drawn = [model.select(torch.from_numpy(near)), _dots(tool, 0.004, _TOOL)]
    view, depth = map_view(GaussianModel.concatenate(drawn), camera, T_world_camera)
    time = trajectory.duration / 2 if nearest is None else nearest.time
    start, shown, goal = arm.T_world_base @ fk(trajectory.at(np.array([0.0, time, trajectory.duration])).position)
    draw = partial(draw_robot, view, depth, camera, T_world_camera)
    draw(parts, shown)
    draw(parts, start, tint=_START, opacity=CONSTANTS.end_opacity)
    draw(parts, goal, tint=_END, opacity=CONSTANTS.end_opacity)
    legend = [("arm at the start", _START_SHADE), ("arm at the goal", _END_SHADE), ("path of the tool", _TOOL)]
    if nearest is not None:
        draw(sphere_parts(arm.spheres, nearest.link, arm.margin, _SHELL), shown, opacity=CONSTANTS.shell_opacity)
        view = _ringed(view, camera, T_world_camera, nearest.point)
        least = f"ring: nearest to {nearest.obstacle}, {1e3 * nearest.clearance:.1f} mm beyond the margin"
        legend.append((f"{least}, at {nearest.time:.1f} s", _NEAREST))
        legend.append(
            (f"shell: certified spheres of the nearest link, and {1e3 * arm.margin:.1f} mm of margin", _SHELL)
        )
    view = with_legend(view, legend)
    return to_png(with_scale(view, camera, away, "at the middle of the picture"), "rgb")


def refused_png(
    model: GaussianModel,
    arm: RobotSpheres,
    q: Array,
    parts: Sequence[DrawnPart],
    fk: Callable[[Array], Array],
    *,
    point: Array,
    reason: str,
    solids: GaussianModel | None = None,
    width: int = 960,
) -> bytes:
    """Render the map with the arm at a configuration that is refused, and a ring at the place of the collision.

    Args:
        model: the map.
        arm: collision spheres of the robot with the pose of its base.
        q: (J,) the configuration [rad or m].
        parts: appearance of the robot.
        fk: returns the poses T_base_link (K, L, 4, 4) of its links at joint positions (K, J).
        point: (3,) place of the collision [m, base].
        reason: of the refusal, for the legend.
        solids: obstacles that are not in the map. Those near the place are drawn in violet.
        width: of the image [px]; the height is 3/4 of it, and a legend below.
    """
    camera, T_world_camera, away = _framed(arm, q[None], width)
    at = transform_points(arm.T_world_base, point[None])[0]
    drawn = [model.select(torch.from_numpy(_within(model, inverse(arm.T_world_base))))]
    legend = [("arm at the refused configuration", _END_SHADE), (f"ring: {reason}", _NEAREST)]
    dots = np.zeros((0, 3)) if solids is None else solids.means.double().numpy()
    dots = dots[np.linalg.norm(dots - at, axis=1) < CONSTANTS.shown_solids]
    if len(dots):
        drawn.append(_dots(dots, 0.003, _SOLID))
    view, depth = map_view(GaussianModel.concatenate(drawn), camera, T_world_camera)
    if _visible(dots, depth, camera, T_world_camera).any():
        legend.append(("obstacles that are not in the map: support plane, unknown space", _SOLID))
    draw_robot(
        view, depth, camera, T_world_camera, parts, arm.T_world_base @ fk(q[None])[0], tint=_END_SHADE, opacity=0.8
    )
    view = _ringed(view, camera, T_world_camera, at)
    return to_png(over_legend(with_scale(view, camera, away, "at the middle of the picture"), legend), "rgb")


def _visible(points: Array, depth: NDArray[np.float32], camera: Camera, T_world_camera: Array) -> NDArray[np.bool_]:
    """Return which points (P, 3) [m, world] are in an image and not behind the surfaces of its depth (H, W) [m]."""
    x, y, z = transform_points(inverse(T_world_camera), points).T
    ahead = np.maximum(z, 1e-6)
    u, v = np.rint(camera.fx * x / ahead + camera.cx), np.rint(camera.fy * y / ahead + camera.cy)
    inside = (z > 0.0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    found = np.zeros(len(points), np.bool_)
    behind = depth[v[inside].astype(np.int64), u[inside].astype(np.int64)]
    found[inside] = (behind <= 0.0) | (z[inside] < behind + CONSTANTS.visible_depth)
    return found


def _framed(arm: RobotSpheres, q: Array, width: int) -> tuple[Camera, Array, float]:
    """Return a camera that shows the arm at all configurations (K, J), its pose (4, 4) and its distance [m]."""
    camera = Camera(0.9 * width, 0.9 * width, (width - 1) / 2, (width * 3 // 4 - 1) / 2, width, width * 3 // 4)
    points = transform_points(inverse(arm.T_world_base), arm.centers(q).reshape(-1, 3))
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    radius = float(np.linalg.norm(points - middle, axis=1).max())
    away = float(radius / np.sin(np.arctan2(camera.height / 2, camera.fy)) + 1e-6)
    return camera, arm.T_world_base @ look_at(middle + away * _FROM / np.linalg.norm(_FROM), middle), away


def framed_from(seen_from: Array, arm: RobotSpheres, q: Array, tool: Array, width: int) -> tuple[Camera, Array, float]:
    """Return a camera at a given place that shows the arm and 15 cm around the path of its tool.

    Args:
        seen_from: (3,) place of the camera [m, base].
        arm: collision spheres of the robot.
        q: (K, J) configurations of the motion.
        tool: (K, 3) path of the tool [m, world].
        width: of the image [px].

    Returns:
        The camera, its pose (4, 4) in the world, and its distance from the middle of the motion [m].

    Raises:
        InputError: the place is within the motion.
    """
    height = width * 3 // 4
    cube = CONSTANTS.around_tool * np.array(list(product((-1, 1), repeat=3)))
    around = (tool[:, None] + cube).reshape(-1, 3)
    points = transform_points(inverse(arm.T_world_base), np.concatenate([arm.centers(q).reshape(-1, 3), around]))
    middle = (points.min(axis=0) + points.max(axis=0)) / 2
    T_base_camera = look_at(seen_from, middle)
    x, y, z = transform_points(inverse(T_base_camera), points).T
    if not z.min() > 0.0:
        place = ", ".join(f"{value:g}" for value in seen_from)
        raise InputError(f"is ({place}), within the motion.", field="seen_from", hint="give a place farther away [m]")
    rays = np.stack([x / z, y / z])
    low, high = rays.min(axis=1), rays.max(axis=1)
    focal = float(CONSTANTS.filled * (np.array([width, height]) / (high - low)).min())
    cx, cy = (np.array([width - 1, height - 1]) - focal * (low + high)) / 2
    camera = Camera(focal, focal, float(cx), float(cy), width, height)
    return camera, arm.T_world_base @ T_base_camera, float(np.linalg.norm(seen_from - middle))


def _ringed(view: NDArray[np.float32], camera: Camera, T_world_camera: Array, point: Array) -> NDArray[np.float32]:
    """Draw a ring at a point (3,) of the world."""
    x, y, z = transform_points(inverse(T_world_camera), point)
    return with_ring(view, (camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy), _NEAREST)


def _dots(points: Array, radius: float, color: Color) -> GaussianModel:
    return sphere_gaussians(points, np.full(len(points), radius), np.array(color), 0.95)


def _within(model: GaussianModel, T_base_world: Array) -> NDArray[np.int64]:
    """Return indices of the Gaussians around the base, or of all Gaussians if none is near."""
    at = transform_points(T_base_world, model.means.double().numpy())
    rows = np.flatnonzero(np.abs(at).max(axis=1) < CONSTANTS.crop_radius)
    return rows if len(rows) else np.arange(len(model))


def _nearby(model: GaussianModel, T_base_world: Array) -> tuple[Array, NDArray[np.uint8]]:
    """Return the means (P, 3) around the base, in the base frame, and their colours (P, 3)."""
    rows = _within(model, T_base_world)
    rows = rows[evenly_spaced(len(rows), CONSTANTS.max_points)]
    means = transform_points(T_base_world, model.means.double().numpy()[rows])
    return means, bytes_of(model.colors.double().numpy()[rows])

"""Robots drawn as shaded meshes into a rendered view; each pixel shows the nearer of robot and map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.gaussians import GaussianModel
from splatbot.geometry import transform_points
from splatbot.protocols import Array, LinkSpheres
from splatbot.rasterize.views import CONSTANTS as VIEWS
from splatbot.rasterize.views import render_rgbd
from splatbot.report.annotations import Color


@dataclass(frozen=True)
class RobotDrawingConstants:
    """Constants of drawn robots.

    Args:
        samples: rays along each axis of a pixel; more make smoother edges.
        ambient: share of light that comes from all directions.
        tint: share of the tint in the colour of a part.
        sphere_resolution: rings of triangles of a drawn sphere.
    """

    samples: int = 2
    ambient: float = 0.4
    tint: float = 0.55
    sphere_resolution: int = 16


CONSTANTS = RobotDrawingConstants()

BACKGROUND = (0.09, 0.1, 0.12)
_LIGHT = np.array([0.3, 0.55, 0.78])  # unit direction against the optical axis, in the camera frame (-x, -y, -z)


@dataclass(frozen=True, eq=False)
class DrawnPart:
    """Triangles (T, 3, 3) [m, link frame] that move with a link, and their colour (3,) in 0..1."""

    link: int
    triangles: Array
    color: Color


def sphere_parts(spheres: LinkSpheres, link: int, margin: float, color: Color) -> list[DrawnPart]:
    """Return the spheres of a link as parts to draw, each with a radius larger by ``margin`` [m]."""
    import open3d as o3d

    ball = o3d.geometry.TriangleMesh.create_sphere(resolution=CONSTANTS.sphere_resolution)
    triangles = np.asarray(ball.vertices)[np.asarray(ball.triangles)]
    own = spheres.link == link
    return [
        DrawnPart(link, center + (radius + margin) * triangles, color)
        for center, radius in zip(spheres.centers[own], spheres.radii[own], strict=True)
    ]


def map_view(
    model: GaussianModel, camera: Camera, T_world_camera: Array
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Render a map on a dark background: colours (H, W, 3) in 0..1 and depth (H, W) [m], 0 where opacity is < 0.5."""
    colors, alpha, depth = render_rgbd(model, camera, T_world_camera)
    view = colors + (1 - alpha)[..., None] * np.array(BACKGROUND, np.float32)
    return view, np.where(alpha >= VIEWS.min_alpha, depth, np.float32(0))


def draw_robot(
    view: NDArray[np.float32],
    depth: NDArray[np.float32],
    camera: Camera,
    T_world_camera: Array,
    parts: Sequence[DrawnPart],
    T_world_links: Array,
    *,
    tint: Sequence[float] | None = None,
    opacity: float = 1.0,
) -> None:
    """Draw a robot into a view, in place; a later robot is drawn over or behind earlier ones by depth.

    Args:
        view: (H, W, 3) colours in 0..1, changed.
        depth: (H, W) depth of the surfaces in the view [m], 0 without one; changed if the robot is opaque.
        camera: pinhole camera of the view.
        T_world_camera: (4, 4) its pose.
        parts: triangles in the frames of the links.
        T_world_links: (L, 4, 4) poses of the links [m].
        tint: (3,) colour that is mixed in, to distinguish postures. If None, the robot has its own colours.
        opacity: 0..1, small for postures in passing.
    """
    import open3d as o3d

    triangles = [transform_points(T_world_links[part.link], part.triangles) for part in parts]
    scene = o3d.t.geometry.RaycastingScene()
    for corners in triangles:
        flat = np.ascontiguousarray(corners.reshape(-1, 3), dtype=np.float32)
        faces = np.arange(len(flat), dtype=np.uint32).reshape(-1, 3)
        scene.add_triangles(o3d.core.Tensor.from_numpy(flat), o3d.core.Tensor.from_numpy(faces))
    colors = np.array([part.color for part in parts])
    if tint is not None:
        colors = (1 - CONSTANTS.tint) * colors + CONSTANTS.tint * np.asarray(tint)
    fine = (camera.height * CONSTANTS.samples, camera.width * CONSTANTS.samples)
    hits = scene.cast_rays(o3d.core.Tensor.from_numpy(_rays(camera, T_world_camera)))
    reach = hits["t_hit"].numpy().reshape(fine)  # of directions with z = 1, so that it is depth
    known = np.repeat(np.repeat(np.where(depth > 0, depth, np.inf), CONSTANTS.samples, 0), CONSTANTS.samples, 1)
    shown = np.isfinite(reach) & (reach < known)
    owner = hits["geometry_ids"].numpy().reshape(fine)[shown]
    normals = hits["primitive_normals"].numpy().reshape(*fine, 3)[shown] @ T_world_camera[:3, :3]
    # Triangles have two sides; light comes from above and behind the camera.
    facing = np.where(normals[:, 2:] > 0, -normals, normals) @ (-_LIGHT)
    shade = CONSTANTS.ambient + (1 - CONSTANTS.ambient) * np.clip(facing, 0.0, 1.0)
    lit = np.zeros((*fine, 3))
    lit[shown] = colors[owner] * shade[:, None]
    cover, paint = opacity * _pixels(shown.astype(np.float64), camera), _pixels(lit, camera)
    view[:] = view * (1 - cover[..., None]) + opacity * paint
    if opacity == 1.0:
        nearest = np.where(shown, reach, np.inf)
        nearest = nearest.reshape(camera.height, CONSTANTS.samples, camera.width, CONSTANTS.samples).min(axis=(1, 3))
        depth[:] = np.where(np.isfinite(nearest), nearest, depth)


def _rays(camera: Camera, T_world_camera: Array) -> NDArray[np.float32]:
    """Return the rays (S H W S, 6) through evenly spaced points of all pixels, row by row [m, world]."""
    inner = (np.arange(CONSTANTS.samples) + 0.5) / CONSTANTS.samples - 0.5
    u = (np.arange(camera.width)[:, None] + inner).ravel()
    v = (np.arange(camera.height)[:, None] + inner).ravel()
    x, y = np.meshgrid((u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy)
    directions = np.stack([x.ravel(), y.ravel(), np.ones(x.size)], axis=1) @ T_world_camera[:3, :3].T
    origin = np.broadcast_to(T_world_camera[:3, 3], directions.shape)
    return np.ascontiguousarray(np.concatenate([origin, directions], axis=1), dtype=np.float32)


def _pixels(fine: Array, camera: Camera) -> Array:
    """Return the mean of the samples of each pixel: (S H, S W, ...) to (H, W, ...)."""
    s = CONSTANTS.samples
    return np.asarray(fine.reshape(camera.height, s, camera.width, s, *fine.shape[2:]).mean(axis=(1, 3)))

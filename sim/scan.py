"""Simulated scan of a scene by a depth camera from several views: the map that a robot has before it acts."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.gaussians import GaussianModel
from splatbot.geometry import look_at, rotation_to_quat, transform_points
from splatbot.protocols import Array
from splatbot.sim.effects.registry import make_effects
from splatbot.sim.motion import base_of
from splatbot.sim.rays import cast, pixel_rays
from splatbot.sim.twin import Twin
from splatbot.tracking.prepare import normals_of


@dataclass(frozen=True)
class ScanConstants:
    """Constants of maps from rendered views."""

    spacing: float = 4e-3
    """Distance [m] between discs. A smaller one gives more Gaussians and finer edges."""
    distance: float = 0.65
    """Distance [m] of the camera from the centre of the objects."""
    elevations: tuple[float, float] = (np.radians(60.0), np.radians(30.0))
    """Elevations [rad] of the camera over the support, alternating. Steep views show the tops, flat ones the sides."""
    max_range: float = 3.0
    """Range [m] of the camera. Surfaces farther away are missing in the map."""
    tangential_sigma: float = 0.55
    """Standard deviation [spacing] of a disc in its plane. A smaller one leaves gaps between discs, a larger one
    extends objects over their edges."""
    thickness: float = 1e-3
    """Thickness [m] of a disc."""
    base_radius: float = 0.2
    """Radius [m] around the robot's base, whose stand is not mapped. A larger one removes the support next to it."""
    min_cosine: float = 0.2
    """Smallest cosine [1] between surface normal and ray. A smaller one keeps grazing measurements, which are
    inaccurate."""


CONSTANTS = ScanConstants()


def scan(
    twin: Twin, *, views: int = 8, width: int = 320, spacing: float = CONSTANTS.spacing, seed: int = 0
) -> GaussianModel:
    """Create discs on the surfaces that a depth camera at exact poses measures, in the twin's world frame.

    Depth is cast against the twin's collision geometry, with the sensor effects of the scene's camera if any. The arm
    and its stand are masked out. Colours are those of the geoms without lighting. There is no tracking and no
    refinement: each disc is the mean of the measurements in a grid cell.

    Args:
        twin: in its current state.
        views: number of views around the centre of its movable objects.
        width: of an image [px]; the height is 3/4 of it.
        spacing: of the grid [m].
        seed: of the sensor's noise.

    Raises:
        InputError: the scene has only planes, or an argument is out of range.
    """
    if views < 1 or width < 32 or not 1e-3 <= spacing <= 0.1:
        raise InputError("is out of range.", field="scan", hint="give 1 view or more, 32 pixels, 0.001..0.1 m")
    camera = Camera(0.9 * width, 0.9 * width, (width - 1) / 2, (3 * width // 4 - 1) / 2, width, 3 * width // 4)
    section = twin.scene.camera
    effects = make_effects(section.sensor if section is not None else (), seed=seed, why="sensor of the scan")
    middle = _middle(twin)
    poses = [_pose(middle, k, views) for k in range(views)]
    mujoco.mj_forward(twin.world.model, twin.data)
    frames = [_frame(twin, camera, T, k) for k, T in enumerate(poses)]
    points, normals, colors = (np.concatenate(c) for c in zip(*(
        _measured(frame, poses[frame.index]) for frame in effects.over(frames)), strict=True))  # fmt: skip
    base = base_of(twin.scene)
    away = np.linalg.norm((points - base[:3, 3])[:, :2], axis=1) > CONSTANTS.base_radius
    return discs(*_averaged(points[away], normals[away], colors[away], spacing), spacing)


def discs(points: Array, normals: Array, colors: Array, spacing: float) -> GaussianModel:
    """Create thin Gaussians at points (P, 3) [m] with normals (P, 3) and a spacing of about ``spacing`` [m]."""
    return GaussianModel.from_activated(
        means=points,
        quats=rotation_to_quat(_upright(normals)),
        scales=np.tile(
            [CONSTANTS.tangential_sigma * spacing, CONSTANTS.tangential_sigma * spacing, CONSTANTS.thickness],
            (len(points), 1),
        ),
        opacities=np.full(len(points), 0.9),
        colors=colors,
    )


def _middle(twin: Twin) -> Array:
    objects = [obj for obj in twin.scene.objects if all(shape.kind != "plane" for shape in obj.shapes)]
    objects = [obj for obj in objects if obj.movable] or objects
    if not objects:
        raise InputError("has no object to scan.", field=twin.scene.name, hint="give it objects")
    at = np.array([twin.data.body(f"object/{obj.name}").xpos for obj in objects])
    return np.asarray((at.min(axis=0) + at.max(axis=0)) / 2)


def _pose(middle: Array, k: int, views: int) -> Array:
    turn, steep = 2 * np.pi * (k + 0.5) / views, CONSTANTS.elevations[k % len(CONSTANTS.elevations)]
    side = np.array([np.cos(turn) * np.cos(steep), np.sin(turn) * np.cos(steep), np.sin(steep)])
    return look_at(middle + CONSTANTS.distance * side, middle)


def _frame(twin: Twin, camera: Camera, T_world_camera: Array, index: int) -> Frame:
    """Render depth along the optical axis and colours; pixels of the arm are 0 in both."""
    world = twin.world
    geoms, depth = cast(world.model, twin.data, pixel_rays(camera), T_world_camera, CONSTANTS.max_range)
    hit = (depth > 0) & ~world.of_robot[geoms]
    rgb = np.where(hit[..., None], 255.0 * np.asarray(world.model.geom_rgba)[geoms, :3], 0.0)
    return Frame(
        float(index),
        rgb.astype(np.uint8),
        np.where(hit, depth, 0.0).astype(np.float32),
        camera,
        index,
        source=f"scan of {twin.scene.name} #{index}",
    )


def _measured(frame: Frame, T_world_camera: Array) -> tuple[Array, Array, Array]:
    """Backproject pixels with a normal to points (P, 3) [m], normals (P, 3) and colours (P, 3) in the world."""
    normals = normals_of(frame.depth, frame.camera).astype(np.float64)
    points = frame.camera.backproject(frame.depth).astype(np.float64)
    rays = points / np.maximum(np.linalg.norm(points, axis=-1, keepdims=True), 1e-9)
    good = (frame.depth > 0) & (-(normals * rays).sum(axis=-1) > CONSTANTS.min_cosine)
    R = T_world_camera[:3, :3]
    return transform_points(T_world_camera, points[good]), normals[good] @ R.T, frame.rgb[good] / 255.0


def _averaged(points: Array, normals: Array, colors: Array, spacing: float) -> tuple[Array, Array, Array]:
    """Average points, normals and colours over grid cells."""
    cells = np.floor(points / spacing).astype(np.int64)
    group, count = np.unique(cells, axis=0, return_inverse=True, return_counts=True)[1:]
    means = []
    for values in (points, normals, colors):
        total = np.zeros((len(count), 3))
        np.add.at(total, group.reshape(-1), values)
        means.append(total / count[:, None])
    length = np.linalg.norm(means[1], axis=1, keepdims=True)
    kept = length[:, 0] > 0.3  # shorter means contain both sides of a thin object
    return means[0][kept], (means[1] / np.maximum(length, 1e-9))[kept], means[2][kept]


def _upright(normals: Array) -> Array:
    """Return rotations (P, 3, 3) whose z axes are the normals (P, 3)."""
    other = np.where(np.abs(normals[:, :1]) < 0.9, [[1.0, 0.0, 0.0]], [[0.0, 1.0, 0.0]])
    x = np.cross(other, normals)
    x /= np.linalg.norm(x, axis=1, keepdims=True)
    return np.stack([x, np.cross(normals, x), normals], axis=-1)

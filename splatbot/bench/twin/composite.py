"""The twin's picture of a robot among Gaussians against MuJoCo's of the true shapes, and against the film of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from tempfile import TemporaryDirectory

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.bench.film import Film, FilmedMap, map_film, shoot
from splatbot.bench.tabletop import Tabletop, tabletop
from splatbot.bench.twin.paths import truth_scene
from splatbot.camera import Camera
from splatbot.evaluation.image import psnr
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, look_at
from splatbot.protocols import Array
from splatbot.rasterize.views import render_view
from splatbot.robots.robot import RobotModel
from splatbot.sim.bodies_view import BodiesView
from splatbot.sim.camera import TwinCamera
from splatbot.sim.scene import make_scene
from splatbot.sim.solids import rpy_of
from splatbot.sim.twin import Twin
from splatbot.sim.view import TwinView


@dataclass(frozen=True)
class CompositeConstants:
    """Constants of the twin over pictures.

    Args:
        held_out_period: [frames] period of the frames that are not mapped.
        reach: fraction of each joint's range, to both sides of home.
        paper: [m] standard deviation of the Gaussians across the table top.
        camera_distance: [m] distance of the cameras from the middle of the table.
    """

    held_out_period: int = 5
    reach: float = 0.35
    paper: float = 1e-4
    camera_distance: float = 1.5


CONSTANTS = CompositeConstants()


_CAMERA = {"at": [1.5, -0.9, 0.9], "look_at": [0.35, 0.0, 0.25]}  # the poses are given with each picture


@dataclass(frozen=True)
class Composites:
    """Agreement of the composite pictures.

    Args:
        overlap: (P,) of each pose, intersection over union of the robot's pixels with those in MuJoCo's picture.
        astray: (P,) of each pose, how far the farthest pixel that differs is from the outline there [px].
        plain_db: (P,) PSNR of the map alone against a frame that was not mapped, where the robot is not; or NaN.
        composite_db: (P,) of the composite picture, at the same pixels.
    """

    overlap: Array
    astray: Array
    plain_db: Array
    composite_db: Array


def exact_map(poses: int, gaussians: int, *, width: int = 320, seed: int = 0) -> Composites:
    """Compare pictures of paper-thin Gaussians on the true shapes, from all sides.

    With the usual thickness of 1.5 mm, the surface of the map would occlude a strip behind each edge.
    """
    table, rng = tabletop(), np.random.default_rng(seed)
    turns, heights = rng.uniform(-2.6, 2.6, poses), rng.uniform(0.15, 1.0, poses)
    eyes = np.stack(
        [0.45 + CONSTANTS.camera_distance * np.cos(turns), CONSTANTS.camera_distance * np.sin(turns), heights], axis=1
    )
    views = np.array([look_at(eye, np.array([0.45, 0.0, 0.2])) for eye in eyes])
    model = table.gaussians(gaussians)
    model.log_scales[:, 2] = np.log(CONSTANTS.paper)
    return _compare(table, model, np.eye(4), views, _pinhole(width), rng, None)


def filmed_map(poses: int, frames: int, *, width: int = 320, seed: int = 0) -> Composites:
    """Compare pictures of a SLAM map of a noisy film, at the poses of held-out frames."""
    table, rng = tabletop(), np.random.default_rng(seed)
    film = shoot(table, frames, width, seed)
    held = np.arange(CONSTANTS.held_out_period // 2, frames, CONSTANTS.held_out_period)
    kept = [i for i in range(frames) if i not in held]
    mapped: FilmedMap = map_film(Film([film.frames[i] for i in kept], film.T_scene_camera[kept]))
    shown = held[np.linspace(0, len(held) - 1, min(poses, len(held))).astype(int)]
    images = [film.frames[i].rgb for i in shown]
    T = inverse(mapped.T_map_scene)
    camera = film.frames[0].camera
    return _compare(table, mapped.snapshot.model, T, film.T_scene_camera[shown], camera, rng, images)


def _compare(
    table: Tabletop,
    model: GaussianModel,
    T_scene_map: Array,
    views: Array,
    camera: Camera,
    rng: np.random.Generator,
    images: list[NDArray[np.uint8]] | None,
) -> Composites:
    with TemporaryDirectory() as folder:
        model.save(Path(folder) / "map.ply")
        place = {"at": T_scene_map[:3, 3].tolist(), "rpy": rpy_of(T_scene_map[:3, :3])}
        clutter = {"file": str(Path(folder) / "map.ply"), "ellipsoids": 0, "objects": False, **place}
        twin = Twin(make_scene({"name": "map", "map": clutter, "camera": _CAMERA}))
    truth = Twin(make_scene(truth_scene(table).model_dump() | {"camera": _CAMERA}))
    eye, oracle = TwinCamera(twin.world, camera=camera), BodiesView(truth.world, camera, map_too=True)
    found = []
    for i, T in enumerate(views):
        q = _posture(twin.world.robot, rng)
        twin.reset(q)
        truth.reset(q)
        seen, robot = eye.view(twin.data, T), oracle.robot(truth.data, T) >= 0.5
        image = images[i] if images is not None else None
        likeness = _likeness(model, camera, inverse(T_scene_map) @ T, seen, image)
        found.append((*_agreement(seen.bodies >= 0.5, robot), *likeness))
    eye.close()
    oracle.close()
    return Composites(*np.array(found).T)


def _agreement(shown: NDArray[np.bool_], truth: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the IoU, and the largest distance of a wrong pixel from the true outline [px]."""
    union = np.count_nonzero(shown | truth)
    overlap = np.count_nonzero(shown & truth) / union if union else 1.0
    inside, outside = (cv2.distanceTransform(m.astype(np.uint8), cv2.DIST_L2, 5) for m in (truth, ~truth))
    return overlap, float(np.where(shown != truth, inside + outside, 0.0).max())


def _likeness(
    model: GaussianModel, camera: Camera, T_map_camera: Array, seen: TwinView, image: NDArray[np.uint8] | None
) -> tuple[float, float]:
    """Return the PSNR [dB] of the plain and of the composite picture outside the bodies; NaN without a frame."""
    if image is None:
        return np.nan, np.nan
    free = seen.bodies == 0.0
    plain = render_view(model, camera, T_map_camera)
    composite = seen.rgb().astype(np.float32) / 255.0
    truth = image.astype(np.float32) / 255.0
    return psnr(plain[free], truth[free]), psnr(composite[free], truth[free])


def _posture(robot: RobotModel | None, rng: np.random.Generator) -> Array:
    assert robot is not None
    half = CONSTANTS.reach * 0.5 * (robot.chain.upper - robot.chain.lower)
    return np.clip(robot.home + rng.uniform(-half, half), robot.chain.lower, robot.chain.upper)


def _pinhole(width: int) -> Camera:
    height, f = width * 3 // 4, 525.0 * width / 640.0
    return Camera(f, f, (width - 1) / 2, (height - 1) / 2, width, height)

"""A film of the table top by a noisy depth camera on an arc, and its map."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.bench.collision.peers import solid_mesh
from splatbot.bench.tabletop import Tabletop
from splatbot.camera import Camera
from splatbot.collision.visibility import measured_depths
from splatbot.frame import Frame
from splatbot.gaussians import Snapshot
from splatbot.geometry import look_at, transform_points
from splatbot.logs.effects import make_effects
from splatbot.logs.raycast import RaycastScene, RaycastSurface
from splatbot.logs.shapes import box
from splatbot.logs.textures import Texture
from splatbot.protocols import Array
from splatbot.slam import Slam
from splatbot.trajectory import Trajectory

NOISY = ("depth_noise", "depth_holes")
TARGET, RADIUS = np.array([0.5, 0.1, 0.1]), 1.15  # [m] centre and radius of the camera's arc
MIDDLE, SWING = 0.70, 0.15  # [m] height over the table top
ARC = np.radians(75.0)  # to both sides of the robot
FULL_ARC = 120  # frames; fewer cover a part of it
RATE = 30.0  # [Hz]
_FLOOR = RaycastSurface(
    box([8.0, 8.0, 0.02]).placed([0.5, 0.0, -0.8]), Texture((0.60, 0.58, 0.55), (0.30, 0.30, 0.33), 0.30)
)
_COLORS = ((0.80, 0.62, 0.42), (0.85, 0.85, 0.80), (0.20, 0.70, 0.35), (0.95, 0.55, 0.15), (0.15, 0.40, 0.60))


@dataclass(frozen=True, eq=False)
class Film:
    """Frames of the shapes with their exact poses.

    Args:
        frames: Frames whose depth has noise and holes.
        T_scene_camera: (F, 4, 4), exact poses.
    """

    frames: list[Frame]
    T_scene_camera: Array

    def observed(self, points: Array) -> NDArray[np.bool_]:
        """Return whether the depth image of any frame, at its true pose, observes each surface point (P, 3)."""
        seen = np.zeros(len(points), np.bool_)
        for frame, T in zip(self.frames, self.T_scene_camera, strict=True):
            rows, measured, z = measured_depths(points, frame.depth, frame.camera, T)
            seen[rows[np.abs(measured - z) < 0.02]] = True
        return seen


@dataclass(frozen=True, eq=False)
class FilmedMap:
    """The map of a film by `Slam`.

    Args:
        film: The mapped film.
        snapshot: Snapshot of the map; its world frame is the first camera.
        T_world_camera: (F, 4, 4), estimated poses, NaN where lost.
    """

    film: Film
    snapshot: Snapshot
    T_world_camera: Array

    @property
    def T_map_scene(self) -> Array:
        """Exact pose (4, 4) of the scene; the first camera is the world frame of the map."""
        return np.asarray(np.linalg.inv(self.film.T_scene_camera[0]))

    def views(self) -> Iterator[tuple[NDArray[np.float32], Camera, Array]]:
        """Yield depth, camera and estimated pose of each tracked frame, the information available to the map."""
        for frame, T in zip(self.film.frames, self.T_world_camera, strict=True):
            if np.isfinite(T).all():
                yield frame.depth, frame.camera, T

    def drift(self) -> Array:
        """Return the position error (F,) [m] of each tracked camera, NaN where lost."""
        true = transform_points(self.T_map_scene, self.film.T_scene_camera[:, :3, 3])
        return np.asarray(np.linalg.norm(self.T_world_camera[:, :3, 3] - true, axis=1))


def shoot(scene: Tabletop, frames: int, width: int, seed: int = 0) -> Film:
    """Render a film of the scene from behind the robot, 75 degrees to both sides, 55 to 85 cm above the table.

    The robot is not in the scene. Surfaces that face down or away from it stay unobserved.
    """
    solids = [
        RaycastSurface(solid_mesh(solid), Texture(_COLORS[i % 5], _COLORS[(i + 2) % 5], 0.04, seed=i))
        for i, solid in enumerate(scene.solids)
    ]
    stage = RaycastScene([_FLOOR, *solids])
    f, height = 525.0 * width / 640.0, width * 3 // 4
    camera = Camera(f, f, (width - 1) / 2, (height - 1) / 2, width, height)
    poses = np.array([_pose(i / FULL_ARC) for i in range(frames)])
    stamps = np.arange(frames) / RATE
    effects = make_effects(NOISY, seed=seed).along(Trajectory(stamps, poses))
    shot = []
    for i, (t, T) in enumerate(zip(stamps, poses, strict=True)):
        rgb, depth = stage.render(camera, T)
        shot.append(effects(Frame(float(t), rgb, depth, camera, i, source=f"table top#{i}")))
    return Film(shot, poses)


def map_film(film: Film) -> FilmedMap:
    """Map a film by SLAM, without its poses."""
    slam = Slam()
    for frame in film.frames:
        slam.process(frame)
    slam.finish()
    lost = np.full((4, 4), np.nan)
    poses = [lost if r.T_world_camera is None else r.T_world_camera for r in slam.results]
    return FilmedMap(film, slam.snapshot(), np.array(poses))


def _pose(share: float) -> Array:
    """Return T_scene_camera (4, 4) after a share of the arc."""
    turn = np.pi + ARC * np.sin(2 * np.pi * share)
    height = MIDDLE + SWING * np.cos(4 * np.pi * share)
    eye = [TARGET[0] + RADIUS * np.cos(turn), TARGET[1] + RADIUS * np.sin(turn), height]
    return look_at(np.array(eye), TARGET)

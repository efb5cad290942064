"""Simulated scan of a scene by the wrist camera with sensor noise, and the map from it that every stack uses."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache, partial

import numpy as np
from numpy.typing import NDArray

from splatbot.collision.visibility import DepthView
from splatbot.config import Config
from splatbot.errors import InputError
from splatbot.frame import Frame, PosePrior
from splatbot.gaussians import Snapshot
from splatbot.geometry import inverse, look_at, se3_exp, transform_points
from splatbot.grasping.affordance import PointHint
from splatbot.logs.raycast import Moving, RaycastSurface
from splatbot.logs.shapes import box
from splatbot.logs.textures import Texture
from splatbot.mapping.selfmask import SelfMask
from splatbot.planning.ik import solve_ik
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.sim.effects.moving_obstacles import position_on_path
from splatbot.sim.effects.registry import make_effects
from splatbot.sim.rays import cast, pixel_rays
from splatbot.sim.scene import SceneObject
from splatbot.sim.solids import pose_at
from splatbot.sim.trials.scenes import TrialScene
from splatbot.sim.trials.surfaces import surfaces_of
from splatbot.sim.twin import Twin
from splatbot.sim.wrist import T_PANDA_CAMERA, WristLog
from splatbot.slam import Slam

_TARGET, _DISTANCE = np.array([0.5, 0.0, 0.05]), 0.6  # [m] point that the camera is aimed at, and the distance to it


Rings = tuple[tuple[float, tuple[int, ...]], ...]
"""[deg] elevation and azimuths of each ring of views around the table."""


@dataclass(frozen=True)
class TrialScanConstants:
    """Constants of the scan of a trial.

    Args:
        rings: [deg] elevation and azimuths of each ring of views.
        max_depth: [m] depth that is used.
        rate: [Hz] frames per second.
        click_stride: every n-th frame is a candidate for the click.
        pose_sigma: [m], [rad] standard deviation of the camera pose by the arm's joints.
    """

    rings: Rings = (
        (45.0, (-130, -80, -40, 0, 40, 80)),
        (65.0, (80, 40, 0, -40, -80)),
    )
    max_depth: float = 0.95
    rate: float = 4.0
    click_stride: int = 4
    pose_sigma: tuple[float, float] = (5e-4, 5e-4)


CONSTANTS = TrialScanConstants()


# Fine Gaussians that stay where depth put them: refinement on images moves means by millimetres, too much for grasps.
MAPPING = {"stride": 1, "surface_depth_tolerance": 0.01, "means_lr": 0.0, "refine_iterations": 0, "final_iterations": 0}
_TABLE = RaycastSurface(
    box([1.0, 1.4, 0.04]).placed([0.6, 0.0, -0.04]), Texture((0.60, 0.50, 0.40), (0.42, 0.33, 0.25), 0.05)
)


class UnseenError(InputError):
    """No tracked image shows the target, so there is no pixel to click on."""


@dataclass(frozen=True, eq=False)
class TrialScan:
    """Result of scanning and mapping a scene.

    Args:
        frames: without the arm, with the sensor's noise; world = first camera.
        T_world_camera: (F, 4, 4) as tracked, NaN for lost frames.
        T_world_base: (4, 4) by the joints at the first frame.
        snapshot: of the map.
        observers: (N, 3) camera position that first observed each Gaussian [m, world]; NaN if unknown.
        hint: point of the target under a click in one of the frames, from its depth.
        seconds: of mapping.
    """

    frames: tuple[Frame, ...]
    T_world_camera: Array
    T_world_base: Array
    snapshot: Snapshot
    observers: Array
    hint: PointHint
    seconds: float

    @property
    def tracked(self) -> list[tuple[Frame, Array]]:
        """Frames that were not lost, with their poses (4, 4)."""
        return [(f, T) for f, T in zip(self.frames, self.T_world_camera, strict=True) if np.isfinite(T).all()]

    @property
    def views(self) -> list[DepthView]:
        """Depth images of these frames, limited to the used range."""
        return [(usable_depth(frame), frame.camera, T) for frame, T in self.tracked]


def usable_depth(frame: Frame) -> NDArray[np.float32]:
    """Return depth (H, W) [m] without the arm and beyond-range pixels, which become 0."""
    return np.where(frame.valid & (frame.depth < CONSTANTS.max_depth), frame.depth, 0.0).astype(np.float32)


def scan_scene(
    trial: TrialScene,
    *,
    frames: int = 32,
    width: int = 320,
    config: Config | None = None,
    rings: Rings = CONSTANTS.rings,
) -> TrialScan:
    """Move the camera over the scene and map its frames.

    The arm's joints give each camera pose with an error of 0.5 mm and 0.5 mrad, which tracking refines.

    Args:
        trial: the scene.
        frames: number of frames.
        width: of an image [px]; the height is 3/4 of it.
        config: of mapping. If None, it is finer than the default and keeps the means fixed (:data:`MAPPING`).
        rings: views that the camera passes, from first to last.

    Raises:
        UnseenError: no image shows the target.
    """
    log = _log(trial, camera_path(frames, rings), width)
    true = log.ground_truth.T_world_camera
    rng = np.random.default_rng(trial.seed)
    sigma = np.repeat(CONSTANTS.pose_sigma, 3)
    prior_poses = np.stack([T @ se3_exp(sigma * rng.standard_normal(6)) for T in true])
    mask = SelfMask(log.robot, T_PANDA_CAMERA)
    assert trial.scene.camera is not None
    effects = make_effects(trial.scene.camera.sensor, seed=trial.seed, why="sensor of the wrist").along(
        log.ground_truth
    )
    shot = tuple(effects(mask(log[k])) for k in range(frames))
    begin = time.perf_counter()
    slam = Slam(config or Config.model_validate({"mapping": MAPPING, "sensor": {"max_depth": CONSTANTS.max_depth}}))
    for frame, T in zip(shot, prior_poses, strict=True):
        prior = PosePrior(np.diag(2 * sigma**2), T_world_camera=inverse(prior_poses[0]) @ T)
        slam.process(replace(frame, prior=prior))
    slam.finish()
    lost = np.full((4, 4), np.nan)
    poses = np.array([lost if r.T_world_camera is None else r.T_world_camera for r in slam.results])
    snapshot = slam.snapshot()
    seconds = time.perf_counter() - begin
    keyframes = poses[[k for k, result in enumerate(slam.results) if result.keyframe]]
    return TrialScan(
        shot,
        poses,
        inverse(prior_poses[0]),
        snapshot,
        _observers(snapshot, keyframes),
        _click(trial, log, shot, poses),
        seconds,
    )


@cache
def camera_path(frames: int, rings: Rings = CONSTANTS.rings) -> Array:
    """Return the joints (F, J) of a path around the table's centre, by default with a higher ring on the way back.

    Raises:
        InputError: a pose cannot be reached.
    """
    robot = panda()
    near, knots = robot.home, []
    for steep, turns in rings:
        for turn in turns:
            t, s = np.radians([turn, steep])
            eye = _TARGET + _DISTANCE * np.array([np.cos(t) * np.cos(s), np.sin(t) * np.cos(s), np.sin(s)])
            T = look_at(eye, _TARGET)
            T[:3, :2] *= -1.0  # the hand's x axis is directed away from the base, as at home
            found = solve_ik(robot, T @ inverse(T_PANDA_CAMERA) @ robot.T_link_tcp, near=near)
            if not len(found.q):
                raise InputError(f"azimuth {turn} degrees is out of reach.", field="camera path")
            near = found.q[0]
            knots.append(near)
    at = np.linspace(0.0, len(knots) - 1.0, frames)
    return np.stack([np.interp(at, np.arange(len(knots)), column) for column in np.array(knots).T], axis=1)


def _log(trial: TrialScene, joints: Array, width: int) -> WristLog:
    objects = [obj for obj in trial.scene.objects if obj.movable]
    still = [surface for k, obj in enumerate(objects) for surface in surfaces_of(obj, seed=k)]
    moving = {}
    for obj in trial.scene.carried:
        shown = surfaces_of(obj, placed=False)
        moving[obj.name] = Moving(shown, partial(_pose_on_path, obj))
    return WristLog(
        panda(), joints, [_TABLE, *still], T_scene_base=np.eye(4), width=width, rate=CONSTANTS.rate, moving=moving
    )


def _pose_on_path(obj: SceneObject, t: float) -> Array:
    return pose_at(tuple(position_on_path(obj, t)), (0.0, 0.0, 0.0))


def _observers(snapshot: Snapshot, T_world_keyframe: Array) -> Array:
    anchors = snapshot.model.anchors.numpy()
    known = np.concatenate([T_world_keyframe[:, :3, 3], np.full((1, 3), np.nan)])
    inside = (anchors >= 0) & (anchors < len(T_world_keyframe))
    return np.asarray(known[np.where(inside, anchors, len(T_world_keyframe))])


def _click(trial: TrialScene, log: WristLog, frames: Sequence[Frame], poses: Array) -> PointHint:
    """Return the central target pixel with depth in the tracked frame with most of them, as a user would click."""
    twin = Twin(trial.scene)
    best: tuple[int, NDArray[np.bool_]] | None = None
    for k in range(0, len(frames), CONSTANTS.click_stride):
        if not np.isfinite(poses[k]).all():
            continue
        twin.reset(log.joints[k])
        geoms, _ = cast(twin.world.model, twin.data, pixel_rays(log.camera), log.ground_truth.T_world_camera[k], 3.0)
        owners = np.array([*twin.world.owner, ""])
        shows = (owners[geoms] == trial.target) & ~log.shows_robot(k) & (usable_depth(frames[k]) > 0)
        if best is None or shows.sum() > best[1].sum():
            best = k, shows
    if best is None or not best[1].any():
        raise UnseenError("is in no picture.", field=trial.target, hint="give another seed")
    k, shows = best
    v, u = np.nonzero(shows)
    nearest = int(np.argmin((v - v.mean()) ** 2 + (u - u.mean()) ** 2))
    at = log.camera.backproject(usable_depth(frames[k]))[v[nearest], u[nearest]].astype(np.float64)
    return PointHint(transform_points(poses[k], at))

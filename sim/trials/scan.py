"""Simulated scan of a scene by the wrist camera with sensor noise, and the map from it that every stack uses."""

from __future__ import annotations

import time
import zlib
from collections.abc import Callable, Collection, Sequence
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
from splatbot.grasping.affordance import Hint, MaskHint, MasksHint, ObservedView, PointHint
from splatbot.logs.raycast import Moving, RaycastSurface
from splatbot.logs.shapes import box
from splatbot.logs.textures import Texture
from splatbot.mapping.selfmask import SelfMask
from splatbot.planning.ik import solve_ik
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.sim.effects.depth_holes import DepthHoles
from splatbot.sim.effects.moving_obstacles import position_on_path
from splatbot.sim.effects.registry import make_effects
from splatbot.sim.rays import cast, pixel_rays
from splatbot.sim.scene import SceneObject
from splatbot.sim.solids import pose_at
from splatbot.sim.trials.scenes import ANY_TARGET, AROUND_TABLE, TABLE, ScanViews, TrialScene
from splatbot.sim.trials.surfaces import surfaces_of
from splatbot.sim.twin import Twin
from splatbot.sim.wrist import T_PANDA_CAMERA, WristLog
from splatbot.slam import Slam


@dataclass(frozen=True)
class TrialScanConstants:
    """Constants of the scan of a trial.

    Args:
        max_depth: [m] depth that is used.
        rate: [Hz] frames per second.
        mark_stride: every n-th frame may carry a click or a mask.
        pose_sigma: [m], [rad] standard deviation of the camera pose by the arm's joints.
        calibration_sigma: [m], [rad] standard deviation of the hand-eye transform of a trial.
        holes: share of the pixels of a black object, and of those of glass, without depth.
        hole_size: [px] their width.
    """

    max_depth: float = 0.95
    rate: float = 4.0
    mark_stride: int = 4
    pose_sigma: tuple[float, float] = (5e-4, 5e-4)
    calibration_sigma: tuple[float, float] = (1e-3, 2e-3)
    holes: tuple[float, float] = (0.5, 0.8)
    hole_size: float = 12.0


CONSTANTS = TrialScanConstants()


# Fine Gaussians that stay where depth put them: refinement on images moves means by millimetres, too much for grasps.
MAPPING = {"stride": 1, "surface_depth_tolerance": 0.01, "means_lr": 0.0, "refine_iterations": 0, "final_iterations": 0}
_TABLE = RaycastSurface(
    box([1.0, 1.4, 0.04]).placed([0.6, 0.0, -0.04]), Texture((0.60, 0.50, 0.40), (0.42, 0.33, 0.25), 0.05)
)
# A room around the table, 0.75 m above its floor; without it, rays past the table measure nothing.
_ROOM = RaycastSurface(
    box([4.0, 4.0, 2.6]).placed([0.5, 0.0, -0.75]), Texture((0.72, 0.72, 0.70), (0.60, 0.60, 0.62), 0.25)
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
        hints: marks of the target and of the other candidates; a candidate that no frame shows is left out.
        seconds: of mapping.
    """

    frames: tuple[Frame, ...]
    T_world_camera: Array
    T_world_base: Array
    snapshot: Snapshot
    observers: Array
    hints: dict[str, Hint]
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
    viewpoints: ScanViews | None = None,
    calibrated: bool = True,
) -> TrialScan:
    """Move the camera over the scene and map its frames.

    The arm's joints give each camera pose with an error of 0.5 mm and 0.5 mrad, which tracking refines.

    Args:
        trial: the scene.
        frames: number of frames.
        width: of an image [px]; the height is 3/4 of it.
        config: of mapping. If None, it is finer than the default and keeps the means fixed (:data:`MAPPING`).
        viewpoints: of the camera. If None, those of the trial.
        calibrated: whether the hand-eye transform is exact; if not, it has an error that is constant in the scan.

    Raises:
        UnseenError: no image shows the target, nor another candidate.
    """
    joints = camera_path(frames, viewpoints or trial.viewpoints)
    log = _log(trial, joints, width)
    true = log.ground_truth.T_world_camera
    rng = np.random.default_rng(trial.seed)
    sigma = np.repeat(CONSTANTS.pose_sigma, 3)
    error = np.zeros(6) if calibrated else calibration_error(trial.seed)
    prior_poses = np.stack([T @ se3_exp(error) @ se3_exp(sigma * rng.standard_normal(6)) for T in true])
    mask = SelfMask(log.robot, T_PANDA_CAMERA)
    assert trial.scene.camera is not None
    effects = make_effects(trial.scene.camera.sensor, seed=trial.seed, why="sensor of the wrist").along(
        log.ground_truth
    )
    shown = _with_materials(trial, log, joints)
    shot = tuple(effects(mask(shown(k))) for k in range(frames))
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
        _hints(trial, log, shot, poses),
        seconds,
    )


@cache
def camera_path(frames: int, viewpoints: ScanViews = AROUND_TABLE) -> Array:
    """Return the joints (F, J) of a path past viewpoints.

    Raises:
        InputError: a pose cannot be reached.
    """
    robot = panda()
    near, knots = robot.home, []
    target = np.array(viewpoints.target)
    for steep, turns in viewpoints.rings:
        for turn in turns:
            t, s = np.radians([turn, steep])
            eye = target + viewpoints.distance * np.array([np.cos(t) * np.cos(s), np.sin(t) * np.cos(s), np.sin(s)])
            T = look_at(eye, target)
            T[:3, :2] *= -1.0  # the hand's x axis is directed away from the base, as at home
            found = solve_ik(robot, T @ inverse(T_PANDA_CAMERA) @ robot.T_link_tcp, near=near)
            if not len(found.q):
                raise InputError(f"azimuth {turn} degrees is out of reach.", field="camera path")
            near = found.q[0]
            knots.append(near)
    at = np.linspace(0.0, len(knots) - 1.0, frames)
    return np.stack([np.interp(at, np.arange(len(knots)), column) for column in np.array(knots).T], axis=1)


def _log(trial: TrialScene, joints: Array, width: int, without: Collection[str] = ()) -> WristLog:
    objects = [obj for obj in trial.scene.objects if obj.name not in (TABLE, *without) and not obj.path]
    still = [surface for k, obj in enumerate(objects) for surface in surfaces_of(obj, seed=k)]
    moving = {}
    for obj in trial.scene.carried:
        shown = surfaces_of(obj, placed=False)
        moving[obj.name] = Moving(shown, partial(_pose_on_path, obj))
    return WristLog(
        panda(),
        joints,
        [_ROOM, _TABLE, *still],
        T_scene_base=np.eye(4),
        width=width,
        rate=CONSTANTS.rate,
        moving=moving,
    )


def _with_materials(trial: TrialScene, log: WristLog, joints: Array) -> Callable[[int], Frame]:
    """Return the reader of frames whose depth has the errors of black and glass objects.

    Both lose depth in blobs. The other pixels of glass measure the surface behind it.
    """
    glass, black = ([name for name, found in trial.materials.items() if found == m] for m in ("glass", "black"))
    solid = _log(trial, joints, log.camera.width, glass) if glass else log
    bare = _log(trial, joints, log.camera.width, (*glass, *black)) if black else solid

    def read(k: int) -> Frame:
        depth = solid[k].depth.copy()
        depth[_nearer(depth, bare[k].depth) & ~_measured(solid[k], bare[k], CONSTANTS.holes[0], (trial.seed, k, 0))] = (
            0.0
        )
        clear = _nearer(log[k].depth, solid[k].depth)
        depth[clear & ~_measured(log[k], solid[k], CONSTANTS.holes[1], (trial.seed, k, 1))] = 0.0
        return replace(log[k], depth=depth)

    return read


def _nearer(depth: NDArray[np.float32], behind: NDArray[np.float32]) -> NDArray[np.bool_]:
    """Return the pixels (H, W) at which a scene is nearer than the same scene without some objects."""
    return (depth > 0) & ((behind == 0) | (behind > depth + 1e-6))


def _measured(frame: Frame, bare: Frame, holes: float, seed: tuple[int, ...]) -> NDArray[np.bool_]:
    """Return the pixels (H, W) of the objects that only ``frame`` shows whose depth a camera measures."""
    own = replace(frame, depth=np.where(_nearer(frame.depth, bare.depth), frame.depth, np.float32(0)))
    effect = DepthHoles(share=holes, size=CONSTANTS.hole_size)
    return effect.apply(own, np.random.default_rng(seed)).depth > 0


def calibration_error(seed: int) -> Array:
    """Draw the error (6,) [m, rad] of the hand-eye transform of a trial, which is constant in its scan."""
    rng = np.random.default_rng((seed, zlib.crc32(b"calibration")))
    return np.repeat(CONSTANTS.calibration_sigma, 3) * rng.standard_normal(6)


def _pose_on_path(obj: SceneObject, t: float) -> Array:
    return pose_at(tuple(position_on_path(obj, t)), (0.0, 0.0, 0.0))


def _observers(snapshot: Snapshot, T_world_keyframe: Array) -> Array:
    anchors = snapshot.model.anchors.numpy()
    known = np.concatenate([T_world_keyframe[:, :3, 3], np.full((1, 3), np.nan)])
    inside = (anchors >= 0) & (anchors < len(T_world_keyframe))
    return np.asarray(known[np.where(inside, anchors, len(T_world_keyframe))])


def _hints(trial: TrialScene, log: WristLog, frames: Sequence[Frame], poses: Array) -> dict[str, Hint]:
    """Mark each candidate in tracked frames.

    A single target is marked by a click on its central pixel with depth, in the frame with most of them. If any object
    may be picked, masks mark it in every fourth frame, as segmentation of the images would; they are exact.
    """
    twin = Twin(trial.scene)
    shown: dict[str, list[tuple[int, NDArray[np.bool_]]]] = {}
    for k in range(0, len(frames), CONSTANTS.mark_stride):
        if not np.isfinite(poses[k]).all():
            continue
        twin.reset(log.joints[k])
        geoms, _ = cast(twin.world.model, twin.data, pixel_rays(log.camera), log.ground_truth.T_world_camera[k], 3.0)
        owners = np.array([*twin.world.owner, ""])[geoms]
        for name in (trial.target, *trial.others):
            shows = (owners == name) & ~log.shows_robot(k)
            if (shows & (usable_depth(frames[k]) > 0)).any():
                shown.setdefault(name, []).append((k, shows))
    if not shown:
        raise UnseenError("is in no picture.", field=trial.target, hint="give another seed")
    if trial.family not in ANY_TARGET:
        measured = [(k, shows & (usable_depth(frames[k]) > 0)) for k, shows in shown[trial.target]]
        k, shows = max(measured, key=lambda one: int(one[1].sum()))
        return {trial.target: _click_hint(frames[k], poses[k], shows)}
    views = {k: ObservedView(log.camera, poses[k], f.rgb, usable_depth(f)) for k, f in enumerate(frames)}
    return {name: MasksHint(tuple(MaskHint(m, views[k]) for k, m in masks)) for name, masks in shown.items()}


def _click_hint(frame: Frame, T_world_camera: Array, shows: NDArray[np.bool_]) -> PointHint:
    v, u = np.nonzero(shows)
    nearest = int(np.argmin((v - v.mean()) ** 2 + (u - u.mean()) ** 2))
    at = frame.camera.backproject(usable_depth(frame))[v[nearest], u[nearest]].astype(np.float64)
    return PointHint(transform_points(T_world_camera, at))

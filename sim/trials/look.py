"""A scene is looked at by the camera on the arm's wrist, with all its noise, and mapped: what every stack knows."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

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
from splatbot.sim.effects.moving_obstacles import place_on
from splatbot.sim.effects.registry import make_effects
from splatbot.sim.rays import cast, pixel_rays
from splatbot.sim.solids import pose_at
from splatbot.sim.trials.scenes import TrialScene
from splatbot.sim.trials.surfaces import surfaces_of
from splatbot.sim.twin import Twin
from splatbot.sim.wrist import T_PANDA_CAMERA, WristLog
from splatbot.slam import Slam

_MIDDLE, _AWAY = np.array([0.5, 0.0, 0.05]), 0.6  # [m] what the camera looks at, and from how far
_RINGS = ((45.0, (-130, -80, -40, 0, 40, 80)), (65.0, (80, 40, 0, -40, -80)))  # [deg] over the table: turns around it
FARTHEST = 0.95  # [m] of depth that is used
_RATE = 4.0  # [Hz]
_LOOKED = 4  # of the frames, one is looked at for a click
_KNOWN = (5e-4, 5e-4)  # [m], [rad] standard deviation of the camera's pose by the arm's joints
# Fine Gaussians, left where depth put them: refinement for pictures moves means by millimetres, too much for grasps.
MAPPING = {"stride": 1, "surface_depth_tolerance": 0.01, "means_lr": 0.0, "refine_iterations": 0, "final_iterations": 0}
_TABLE = RaycastSurface(
    box([1.0, 1.4, 0.04]).placed([0.6, 0.0, -0.04]), Texture((0.60, 0.50, 0.40), (0.42, 0.33, 0.25), 0.05)
)


class UnseenError(InputError):
    """No picture that was tracked shows the target: there is nothing to click at."""


@dataclass(frozen=True, eq=False)
class Look:
    """What was seen of a scene.

    Args:
        frames: without the arm, with the sensor's noise; world = first camera.
        T_world_camera: (F, 4, 4) as they were tracked, NaN where lost.
        T_world_base: (4, 4), as the joints had it at the first frame.
        snapshot: of the map.
        observers: (N, 3) where each Gaussian was first seen from [m, world], NaN where that is not known.
        hint: the target, clicked at in one of the frames: what its depth has there.
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
        """The depth of these, as far as it was used."""
        return [(usable_depth(frame), frame.camera, T) for frame, T in self.tracked]


def usable_depth(frame: Frame) -> NDArray[np.float32]:
    """Depth (H, W) [m] where it is not the arm's and not too far; 0 elsewhere."""
    return np.where(frame.valid & (frame.depth < FARTHEST), frame.depth, 0.0).astype(np.float32)


def look(trial: TrialScene, *, frames: int = 32, width: int = 320, config: Config | None = None) -> Look:
    """Move the camera over the scene and map what it sees.

    The arm's joints tell each camera's pose to half a millimetre and half a milliradian; tracking refines that.

    Args:
        trial: the scene.
        frames: on the way.
        width: of a picture [px]; 3/4 as high.
        config: of mapping; None: finer than by default, and without moving means (:data:`MAPPING`).

    Raises:
        UnseenError: the target is in no picture.
    """
    log = _log(trial, frames, width)
    true = log.ground_truth.T_world_camera
    rng = np.random.default_rng(trial.seed)
    sigma = np.repeat(_KNOWN, 3)
    told = np.stack([T @ se3_exp(sigma * rng.standard_normal(6)) for T in true])
    mask = SelfMask(log.robot, T_PANDA_CAMERA)
    assert trial.scene.camera is not None
    effects = make_effects(trial.scene.camera.sensor, seed=trial.seed, why="sensor of the wrist").along(
        log.ground_truth
    )
    shot = tuple(effects(mask(log[k])) for k in range(frames))
    begin = time.perf_counter()
    slam = Slam(config or Config.model_validate({"mapping": MAPPING, "sensor": {"max_depth": FARTHEST}}))
    for frame, T in zip(shot, told, strict=True):
        prior = PosePrior(np.diag(2 * sigma**2), T_world_camera=inverse(told[0]) @ T)
        slam.process(replace(frame, prior=prior))
    slam.finish()
    lost = np.full((4, 4), np.nan)
    poses = np.array([lost if r.T_world_camera is None else r.T_world_camera for r in slam.results])
    snapshot = slam.snapshot()
    seconds = time.perf_counter() - begin
    keyframes = poses[[k for k, result in enumerate(slam.results) if result.keyframe]]
    return Look(
        shot,
        poses,
        inverse(told[0]),
        snapshot,
        _observers(snapshot, keyframes),
        _click(trial, log, shot, poses),
        seconds,
    )


@cache
def camera_path(frames: int) -> Array:
    """Joints (F, J) on a way around the table's middle, higher on the way back.

    Raises:
        InputError: a place cannot be reached.
    """
    robot = panda()
    near, knots = robot.home, []
    for steep, turns in _RINGS:
        for turn in turns:
            t, s = np.radians([turn, steep])
            eye = _MIDDLE + _AWAY * np.array([np.cos(t) * np.cos(s), np.sin(t) * np.cos(s), np.sin(s)])
            T = look_at(eye, _MIDDLE)
            T[:3, :2] *= -1.0  # the hand points away from the base, as at home
            found = solve_ik(robot, T @ inverse(T_PANDA_CAMERA) @ robot.T_link_tcp, near=near)
            if not len(found.q):
                raise InputError(f"from {turn} degrees is out of reach.", field="camera path")
            near = found.q[0]
            knots.append(near)
    at = np.linspace(0.0, len(knots) - 1.0, frames)
    return np.stack([np.interp(at, np.arange(len(knots)), column) for column in np.array(knots).T], axis=1)


def _log(trial: TrialScene, frames: int, width: int) -> WristLog:
    things = [thing for thing in trial.scene.objects if thing.movable]
    still = [surface for k, thing in enumerate(things) for surface in surfaces_of(thing, seed=k)]
    moving = {}
    for thing in trial.scene.carried:
        shown = surfaces_of(thing, placed=False)
        moving[thing.name] = Moving(shown, lambda t, thing=thing: pose_at(tuple(place_on(thing, t)), (0.0, 0.0, 0.0)))  # type: ignore[misc]
    joints = camera_path(frames)
    return WristLog(panda(), joints, [_TABLE, *still], T_scene_base=np.eye(4), width=width, rate=_RATE, moving=moving)


def _observers(snapshot: Snapshot, T_world_keyframe: Array) -> Array:
    anchors = snapshot.model.anchors.numpy()
    known = np.concatenate([T_world_keyframe[:, :3, 3], np.full((1, 3), np.nan)])
    inside = (anchors >= 0) & (anchors < len(T_world_keyframe))
    return np.asarray(known[np.where(inside, anchors, len(T_world_keyframe))])


def _click(trial: TrialScene, log: WristLog, frames: Sequence[Frame], poses: Array) -> PointHint:
    """The middle of the target's pixels with depth, in the tracked frame that has most of them, as one would click."""
    twin = Twin(trial.scene)
    best: tuple[int, NDArray[np.bool_]] | None = None
    for k in range(0, len(frames), _LOOKED):
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

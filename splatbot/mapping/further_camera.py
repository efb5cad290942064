"""Further cameras of a map: fixed in the world, carried by the first camera, or free."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from splatbot.config import CameraConfig, Config
from splatbot.frame import Frame
from splatbot.geometry import adjoint, inverse, pose_from_quat
from splatbot.mapping.extrinsics import ConstantPose, MeasuredPose, locate_in_map, viewing_same_place
from splatbot.mapping.keyframes import Keyframe
from splatbot.tracking.estimate import PoseEstimate
from splatbot.tracking.features import Features, match_pose
from splatbot.tracking.nearby_keyframes import is_within, pose_distance
from splatbot.tracking.prepare import PreparedFrame, prepare, typical_depth
from splatbot.tracking.tracker import Tracker

Array = NDArray[np.float64]

RETRY_S = 0.5
"""Time [s] of the stream after a frame whose pose is not accepted, before the next one is tried."""
CHECK_S = 0.5
"""Time [s] of the stream between two checks that a mounted camera is still in its place."""
CHECKS = 3
"""Frames in succession that must agree: that a camera has moved, or that a free camera is found."""
MOVED = (0.01, 0.0175)
"""Distance [m] and angle [rad] by which an aligned frame differs from the known pose if the camera has moved."""


@dataclass(frozen=True)
class MapState:
    """The map and the first camera at the time of a frame of a further camera.

    Args:
        keyframes: all keyframes of the map.
        variance_scale: see :attr:`splatbot.tracking.tracker.Tracker.variance_scale`.
        first: pose of the first camera at the stamp of the frame; None while it is lost or its motion is unknown.
        first_twist: (6,) [m/s, rad/s] velocity of the first camera in its own frame.
    """

    keyframes: Sequence[Keyframe]
    variance_scale: float
    first: MeasuredPose | None
    first_twist: Array

    @property
    def first_keyframes(self) -> list[Keyframe]:
        """Keyframes of the first camera."""
        return [keyframe for keyframe in self.keyframes if not keyframe.camera_name]


class FurtherCamera(Protocol):
    """A camera of the map other than the first one.

    The pose of its last frame moves with a keyframe of the first camera. ``anchor`` is the number of that keyframe. If
    None, it is the keyframe at the time of the frame.
    """

    anchor: int | None

    def prepare(self, frame: Frame, config: Config, state: MapState) -> PreparedFrame:
        """Return the pyramid of a frame, rectified by the expected velocity of the camera."""
        ...

    def track(self, prepared: PreparedFrame, config: Config, state: MapState) -> PoseEstimate:
        """Return the pose of a frame; the verdict is "lost" while it is unknown."""
        ...

    def keypoints(self, prepared: PreparedFrame, estimate: PoseEstimate) -> Callable[[], Features]:
        """Return a function that detects the keypoints of a frame that becomes a keyframe."""
        ...

    def move(self, T_new_old: Array) -> None:
        """Move the pose with a correction (4, 4) of the map at the camera."""
        ...


class MountedCamera:
    """A camera at a constant pose: in the world, or on the first camera that carries it.

    A known pose is checked every half second. Three frames in succession that are aligned elsewhere show that it has
    changed; an estimated pose is then estimated again.

    Args:
        pose: its pose on the world or on the first camera.
        carried: whether the first camera carries it.
    """

    def __init__(self, pose: ConstantPose, *, carried: bool) -> None:
        self.pose, self.carried = pose, carried
        self.anchor: int | None = None
        self._retry_at = self._check_at = -math.inf
        self._misses = 0

    def prepare(self, frame: Frame, config: Config, state: MapState) -> PreparedFrame:
        """Return the pyramid of a frame, rectified by the velocity of the first camera if that carries it."""
        if not self.carried:
            return prepare(frame, config.tracking)
        return prepare(frame, config.tracking, adjoint(inverse(self.pose.T_parent_camera)) @ state.first_twist)

    def track(self, prepared: PreparedFrame, config: Config, state: MapState) -> PoseEstimate:
        """Return the pose of a frame; a pose that is not exact is first estimated against the map."""
        parent = state.first if self.carried else _WORLD
        if parent is None or not state.keyframes:
            unknown = "the first camera is lost, or its motion is unknown"
            return _lost(unknown if state.keyframes else "the map has not begun")
        if not self.pose.known:
            self._estimate(prepared, config, state, parent)
        if not self.pose.known:
            return _lost(self.pose.reason)
        T = parent.T_world_camera @ self.pose.T_parent_camera
        self._check_place(prepared, config, state, T)
        if self._misses:
            return _lost(self.pose.reason)
        if not self.carried and self.anchor is None:
            near = viewing_same_place(state.first_keyframes, T, typical_depth(prepared))
            self.anchor = (state.first_keyframes if self.pose.is_exact else near)[0].number
        A = adjoint(inverse(self.pose.T_parent_camera))
        covariance = self.pose.covariance + A @ parent.covariance @ A.T
        return PoseEstimate(T, "ok", (), "extrinsics", covariance=covariance)

    def keypoints(self, prepared: PreparedFrame, estimate: PoseEstimate) -> Callable[[], Features]:
        """Return a function without keypoints: no frame is matched with those of a mounted camera."""
        return Features.none

    def move(self, T_new_old: Array) -> None:
        """Move the pose of a fixed camera; a carried one moves with the first camera."""
        if not self.carried:
            self.pose.move(T_new_old)

    def _estimate(self, prepared: PreparedFrame, config: Config, state: MapState, parent: MeasuredPose) -> None:
        """Align a frame to the map and add the pose on the parent to those that must agree."""
        stamp = prepared.frame.stamp
        if self._retry_at - RETRY_S <= stamp < self._retry_at:
            return
        start = parent.T_world_camera @ self.pose.start()
        found = locate_in_map(prepared, state.first_keyframes, start, config)
        if not isinstance(found, str):
            A = adjoint(inverse(found.T_world_camera) @ parent.T_world_camera)
            T_parent_camera = inverse(parent.T_world_camera) @ found.T_world_camera
            found = MeasuredPose(T_parent_camera, found.covariance + A @ parent.covariance @ A.T)
        if self.pose.add(found):
            self._check_at = stamp + CHECK_S
        elif isinstance(found, str) or self.pose.is_full:
            self._retry_at = stamp + RETRY_S

    def _check_place(self, prepared: PreparedFrame, config: Config, state: MapState, T_world_camera: Array) -> None:
        """Count the frames in succession that are aligned elsewhere; one that cannot be aligned shows nothing."""
        stamp = prepared.frame.stamp
        if self._check_at - CHECK_S <= stamp < self._check_at:
            return
        found = locate_in_map(prepared, state.first_keyframes, T_world_camera, config)
        distance = (0.0, 0.0) if isinstance(found, str) else pose_distance(T_world_camera, found.T_world_camera)
        self._misses = 0 if is_within(distance, MOVED) else self._misses + 1
        if self._misses:
            moved = f"{1e3 * distance[0]:.0f} mm and {np.degrees(distance[1]):.1f} degrees"
            self.pose.reason = f"its images are at {moved} from its pose"
        if not 0 < self._misses < CHECKS:
            self._check_at = stamp + CHECK_S
        if self._misses >= CHECKS and not self.pose.is_exact:
            self.pose.forget()
            self._misses, self.anchor = 0, None


class FreeCamera:
    """A camera that moves on its own: it is found in the map by its features, and tracked against all keyframes.

    Three frames in succession must confirm the pose by matched features and by alignment to the first camera's
    keyframes. A camera at rest repeats a wrong pose, so its agreement with itself shows nothing.

    Args:
        config: of the camera.
    """

    def __init__(self, config: Config) -> None:
        self.tracker = Tracker(config.tracking)
        self.forget()

    def forget(self) -> None:
        """Discard pose and confirmation: the camera may be anywhere in the map, and is searched at the next frame."""
        self.tracker.forget()
        self.anchor: int | None = None
        self._confirmed = 0
        self._retry_at = -math.inf

    def prepare(self, frame: Frame, config: Config, state: MapState) -> PreparedFrame:
        """Return the pyramid of a frame, rectified by the velocity of the camera."""
        return prepare(frame, config.tracking, self.tracker.expected_twist(frame.stamp))

    def track(self, prepared: PreparedFrame, config: Config, state: MapState) -> PoseEstimate:
        """Return the pose of a frame by tracking against all keyframes, once it is confirmed."""
        if not state.keyframes:
            return _lost("the map has not begun")
        stamp = prepared.frame.stamp
        if self._retry_at - RETRY_S <= stamp < self._retry_at:
            return _lost("it is not found in the map")
        self.tracker.variance_scale = state.variance_scale
        estimate = self.tracker.track(prepared, state.keyframes)
        if estimate.verdict == "lost":
            self._confirmed = 0
            if not self.tracker.awaits_confirmation:
                self._retry_at = stamp + RETRY_S
            return estimate
        T = estimate.T_world_camera
        near = viewing_same_place(state.first_keyframes, T, typical_depth(prepared))
        if self._confirmed < CHECKS:
            doubt = self._doubt(prepared, config, near, estimate)
            if doubt:
                self.tracker.forget()
                self._confirmed, self._retry_at = 0, stamp + RETRY_S
                return _lost(doubt)
            self._confirmed += 1
            if self._confirmed < CHECKS:
                return _lost(f"{self._confirmed} of {CHECKS} frames confirm its pose")
        self.anchor = near[0].number
        return estimate

    def keypoints(self, prepared: PreparedFrame, estimate: PoseEstimate) -> Callable[[], Features]:
        """Return a function that detects the keypoints of a frame."""
        return self.tracker.keypoints(prepared, estimate)

    def move(self, T_new_old: Array) -> None:
        """Move the last pose of the camera."""
        self.tracker.move(T_new_old)

    def _doubt(
        self, prepared: PreparedFrame, config: Config, near: Sequence[Keyframe], estimate: PoseEstimate
    ) -> str | None:
        """Return why features or alignment do not confirm a pose, or None if they do."""
        T, current = estimate.T_world_camera, self.tracker.keypoints(prepared, estimate)()
        known = [(keyframe.features, keyframe.T_world_camera) for keyframe in near[: config.tracking.match_keyframes]]
        matched = match_pose(current, known, prepared.frame.camera)
        if matched is None or len(matched.points) < config.loops.min_matches:
            return "too few features confirm its pose"
        if not is_within(pose_distance(T, matched.T_world_camera), MOVED, times=2):
            return "its features contradict its pose"
        found = locate_in_map(prepared, near, T, config)
        if isinstance(found, str):
            return found
        return None if is_within(pose_distance(T, found.T_world_camera), MOVED) else "the map contradicts its pose"


def make_camera(camera: CameraConfig, config: Config) -> FurtherCamera:
    """Return the further camera that a configuration describes.

    Args:
        camera: its description.
        config: configuration of the run with the camera's sensor, see :meth:`splatbot.config.Config.of_camera`.
    """
    given = camera.T_world_camera or camera.T_first_camera
    if given is None:
        return FreeCamera(config)
    T = pose_from_quat(given.translation, given.quaternion_wxyz)
    pose = ConstantPose(T, (camera.translation_sigma, camera.rotation_sigma))
    return MountedCamera(pose, carried=camera.T_first_camera is not None)


_WORLD = MeasuredPose(np.eye(4), np.zeros((6, 6)))


def _lost(reason: str) -> PoseEstimate:
    return PoseEstimate(np.eye(4), "lost", (reason,), "extrinsics")

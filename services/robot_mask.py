"""The robot's own body in live frames: masked by the joint states, or by TF, at the time of each image."""

from __future__ import annotations

import bisect
import logging
import threading
import time
from collections.abc import Iterable, Iterator, Mapping

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.geometry import inverse, transform_points
from splatbot.logs import Log
from splatbot.logs.joints import MAX_GAP, interpolate_joints, select_joints
from splatbot.mapping.selfmask import SAME_TIME_S, JointsUnknownError, SelfMask, knows_joints
from splatbot.protocols import Array, FrameSource
from splatbot.robots.in_view import recorded_links, self_mask
from splatbot.robots.joint_offsets import robot_in_scene
from splatbot.robots.link_poses import LinkPoses
from splatbot.robots.robot import RobotModel
from splatbot.robots.tf_buffer import TransformBuffer
from splatbot.services.ros.robot_topics import RobotTopics
from splatbot.services.topics import JointState
from splatbot.workspace import Workspace

MAX_HELD = 64
"""Largest number of spheres of an object in the hand."""
_KEPT_S = 10.0  # [s] of joint states
_SET_BACK_S = 0.5  # [s] by which a state may be older than the newest one
_KEPT = 20_000  # joint states: 2 kHz over that time
_WAIT_S = 0.15  # [s] for the joint state after an image
_REPORT_S = 10.0  # [s] between two warnings about frames that are not mapped

_log = logging.getLogger(__name__)


class JointHistory:
    """The joint states of the last 10 s; any thread adds to it, and mapping reads it.

    Args:
        names: of the joints, in the robot's order.
    """

    def __init__(self, names: Iterable[str]) -> None:
        self.names = tuple(names)
        self._stamps: list[float] = []
        self._positions: list[NDArray[np.float64]] = []
        self._named = False
        self._changed = threading.Condition()

    def clear(self) -> None:
        """Forget all states: the clock was set."""
        with self._changed:
            self._forget()

    def _forget(self) -> None:
        self._stamps.clear()
        self._positions.clear()

    def add(self, state: JointState) -> bool:
        """Add a joint state, in any order. States from before a clock was set back are forgotten.

        Returns:
            False if the state has no joint of the robot, as that of a gripper, or numbers its joints although others
            have names.

        Raises:
            InputError: the state has only some joints of the robot, or a value is not finite.
        """
        try:
            q = select_joints(state.names, np.asarray(state.position, np.float64), self.names)
        except InputError:
            if set(state.names).isdisjoint(self.names):
                return False
            raise
        if not np.isfinite(q).all() or not np.isfinite(state.stamp):
            raise InputError("has values that are not finite.", field="joints", hint="give seconds, radians and metres")
        named = not set(state.names).isdisjoint(self.names)
        with self._changed:
            if self._named and not named:
                return False  # of another device, which numbers its joints
            if self._stamps and self._stamps[-1] - state.stamp > _SET_BACK_S:
                self._forget()
            self._named = self._named or named
            at = bisect.bisect_left(self._stamps, state.stamp)
            if at < len(self._stamps) and self._stamps[at] == state.stamp:
                self._positions[at] = q
            else:
                self._stamps.insert(at, state.stamp)
                self._positions.insert(at, q)
            old = max(bisect.bisect_left(self._stamps, self._stamps[-1] - _KEPT_S), len(self._stamps) - _KEPT)
            del self._stamps[:old], self._positions[:old]
            self._changed.notify_all()
        return True

    def reaches(self, stamp: float) -> bool:
        """Return whether the newest joint state is at most 0.1 s before a stamp [s], or after it."""
        with self._changed:
            return bool(self._stamps) and self._stamps[-1] >= stamp - MAX_GAP

    def at(self, stamp: float, wait_s: float) -> NDArray[np.float64]:
        """Interpolate the positions (J,) [rad or m] at a stamp [s]; wait up to ``wait_s`` [s] for a later state.

        Raises:
            JointsUnknownError: no state within 0.1 s before the stamp, or none within 0.1 s after it.
        """
        with self._changed:
            self._changed.wait_for(lambda: self._stamps and self._stamps[-1] >= stamp, wait_s)
            after = bisect.bisect_left(self._stamps, stamp)
            stamps = np.array(self._stamps[max(after - 1, 0) : after + 1])
            joints = np.array(self._positions[max(after - 1, 0) : after + 1])
            newest = self._stamps[-1] if self._stamps else None
        between = len(stamps) > 0 and stamps[0] <= stamp <= stamps[-1]
        found = interpolate_joints(stamps, joints, stamp, hold=0.0) if between else None
        if found is None:
            known = "no joint state has come" if newest is None else f"the newest is {stamp - newest:+.3f} s before it"
            hint = f"publish joint states with the images, with stamps of their clock, at {1 / MAX_GAP:.0f} Hz or more"
            raise JointsUnknownError(
                f"joint states at {stamp:.3f} s are missing or stale: {known}.", field="joints", hint=hint
            )
        return found


class RobotMask:
    """Masks the robot, and the object in its hand, in the frames of one live map.

    A frame with joints of its own at the times of colour and depth is masked by these. Otherwise its joints are those
    of the history at both times, plus the workspace's ``joint_delay``. Where no joint states come, the poses of the
    links are those of TF. So is the pose of the camera if it is not known on its link; then TF counts alone. A frame
    without known joints or poses is refused: it must not be mapped. So is a frame of a further camera without a
    workspace of its own.

    Frames of a recording are masked as `splatbot map --robot` does it: by their own joints, else by the recorded TF.

    Args:
        robot: the robot.
        workspace: pose of the camera on its link, and names, offsets and delay of the joints.
        topics: transforms and attached objects; those of clients are not of the frames of a recording.
        camera_in_tf: the pose of the camera may be missing in the workspace.
        log: the recording whose frames are masked, if they are not live. Where it has TF, the pose of the camera may be
            missing, too.
        further: workspaces of further cameras by name, each with the pose of its camera on a link.

    Raises:
        InputError: the pose of a camera is unknown, or a workspace does not fit the robot.
    """

    def __init__(
        self,
        robot: RobotModel,
        workspace: Workspace | None,
        topics: RobotTopics | None = None,
        *,
        camera_in_tf: bool = False,
        further: Mapping[str, Workspace] | None = None,
        log: Log | None = None,
    ) -> None:
        self.robot, self._workspace = robot, workspace or Workspace()
        self._workspaces = {"": self._workspace, **(further or {})}
        for scene in self._workspaces.values():
            robot_in_scene(robot, scene)  # refuses offsets with which no plan in the map would begin
        self._recorded = {} if log is None else recorded_links(robot, self._workspaces, log)
        self._in_tf = {*self._recorded, *([""] if camera_in_tf else [])}
        self._topics = topics
        transforms = TransformBuffer() if topics is None else topics.transforms
        self._link_poses = LinkPoses(robot, transforms, self._workspace.tf_prefix)
        self.history = JointHistory(self._workspace.joint_names or robot.chain.names)
        self.masked = 0
        self.refused = 0
        self.problem: str | None = None
        self.problems: dict[str, str] = {}
        """Reasons why the latest frames of cameras were refused, by the name of the camera."""
        self._reported = -np.inf
        self._given = np.zeros((0, 4))
        self._attached, self._version = np.zeros((0, 4)), 0
        self._building = threading.Lock()
        self._build()

    @property
    def joint_delay(self) -> float:
        """Time [s] by which the stamps of joint states are later than the motion."""
        return self._workspace.joint_delay

    def __call__(self, frame: Frame, *, live: bool = True) -> Frame:
        """Return the frame with the robot masked at the times of colour and of depth.

        Args:
            frame: the frame.
            live: whether joint states and topics belong to the frame; those of a recording do not.

        Raises:
            JointsUnknownError: the joints at the time of the frame are missing or stale.
        """
        try:
            if live:
                self._hold_attached()
            links = self._recorded.get(frame.camera_name)
            if links is not None:
                masked = links.mask(self._mask_of(frame), frame)
            elif live and not knows_joints(frame):
                masked = self._masked_live(frame)
            else:
                masked = self._mask_of(frame)(frame)
        except JointsUnknownError as error:
            self._refuse(frame.camera_name, error)
            raise
        self.masked, self.problem = self.masked + 1, None
        self.problems.pop(frame.camera_name, None)
        return masked

    def _mask_of(self, frame: Frame) -> SelfMask:
        """Return the mask for the camera of a frame.

        Raises:
            JointsUnknownError: its pose on the robot is not known.
        """
        found = self._masks.get(frame.camera_name)
        if found is None:
            raise JointsUnknownError(
                f"the mount of camera {frame.camera_name} is not known, so {self.robot.name} cannot be masked.",
                field="camera_name",
                hint="describe it by T_link_camera and camera_link",
            )
        return found

    def _masked_live(self, frame: Frame) -> Frame:
        """Return the frame masked at both times; its own joints count at that of colour."""
        if frame.joints is None:
            masked = self._masked_at(frame, 0.0)
        else:
            masked = self._mask_of(frame).at_joints(frame, frame.joints, frame.joint_names)
        if abs(frame.depth_delay) <= SAME_TIME_S:
            return masked
        try:
            return self._masked_at(masked, frame.depth_delay)
        except JointsUnknownError as error:
            if frame.joints is not None:
                error.hint = f"give depth_joints, the joints at the time of depth; or {error.hint}"
            raise

    def _masked_at(self, frame: Frame, after: float) -> Frame:
        """Return the frame with the robot masked as it is at a time [s] after the frame's stamp."""
        mask, delay = self._mask_of(frame), after + self.joint_delay
        stamp, wait_s = frame.stamp + delay, _WAIT_S + max(delay, 0.0)
        if not mask.has_camera or (self._link_poses and not self.history.reaches(stamp - wait_s)):
            try:
                return self._link_poses.mask(mask, frame, stamp, wait_s)
            except JointsUnknownError:
                if not mask.has_camera or not self.history.reaches(stamp - wait_s):
                    raise  # else the first joint states have come during the wait for TF
        q = self.history.at(stamp, wait_s)
        return mask.at_joints(frame, q, self.history.names)

    def hold(self, spheres: ArrayLike) -> None:
        """Mask an object in the hand from the next frame on, in addition to the attached ones of MoveIt.

        Args:
            spheres: (A, 4) spheres (x, y, z, radius) [m] in the frame of the last link, at most 64; none to release.

        Raises:
            InputError: a sphere is invalid, or there are too many.
        """
        held = np.asarray(spheres, np.float64).reshape(-1, 4)
        if len(held) > MAX_HELD:
            raise InputError(f"has {len(held)} spheres.", field="spheres", hint=f"give at most {MAX_HELD}")
        with self._building:
            before, self._given = self._given, held
            try:
                self._build()
            except InputError:
                self._given = before
                raise
            self._version = -1  # the attached objects share the number of spheres

    def _build(self) -> None:
        held = np.concatenate([self._given, self._attached])
        self._masks = {
            name: self_mask(self.robot, workspace, held=held, needs_camera=name not in self._in_tf)
            for name, workspace in self._workspaces.items()
        }

    def _hold_attached(self) -> None:
        """Mask the objects that are attached now to the last link, or to a frame that it carries.

        Raises:
            JointsUnknownError: the link of an object is not known, or there are too many shapes.
        """
        if self._topics is None or self._topics.attached.version == self._version:
            return
        with self._building:
            version = self._topics.attached.version
            solids = [
                (T_last_link, solid)
                for name, one in self._topics.attached.objects.items()
                if (T_last_link := self._on_last_link(name, one.link)) is not None
                for solid in one.solids
            ]
            left = MAX_HELD - len(self._given)
            if len(solids) > left:
                hint = f"attach at most {MAX_HELD}, with those that a client holds"
                raise JointsUnknownError(f"{len(solids)} attached shapes are too many.", field="attached", hint=hint)
            covers = [(T, solid.spheres(left // len(solids))) for T, solid in solids]
            moved = [np.c_[transform_points(T, spheres[:, :3]), spheres[:, 3]] for T, spheres in covers]
            self._attached = np.concatenate([np.zeros((0, 4)), *moved])
            self._build()
            self._version = version

    def _on_last_link(self, name: str, link: str) -> Array | None:
        """Return T_last_link (4, 4) of a link that the last link carries; None if another link carries it."""
        transforms, frames = self._link_poses.transforms, self._link_poses.frames
        if frames is not None and (carrier := transforms.carrier(link, frames.names)) is not None:
            if carrier != frames.names[-1]:
                return None
            T_frame_link = transforms.newest(carrier, link)
            assert T_frame_link is not None  # the carrier is above the link
            return inverse(frames.T_frame_link[-1]) @ T_frame_link
        hint = "publish its TF, or attach the object to the last link"
        raise JointsUnknownError(f"the link {link} of attached {name[:40]!r} is not known.", field="tf", hint=hint)

    def _refuse(self, camera_name: str, error: JointsUnknownError) -> None:
        self.refused, self.problem = self.refused + 1, error.message
        self.problems[camera_name] = error.message
        if time.monotonic() - self._reported >= _REPORT_S:
            self._reported = time.monotonic()
            _log.warning(
                "%d frames are not mapped, because the robot in them cannot be masked: %s", self.refused, error
            )


class MaskedSource:
    """The frames of a log or a camera with the robot masked; frames that the mask refuses are left out.

    Frames of a log are masked by their own joints, or by the TF of the log, alone.

    Args:
        source: the frames.
        mask: of their robot.
    """

    def __init__(self, source: Iterable[Frame], mask: RobotMask) -> None:
        self._source, self._mask = source, mask
        self._live, self._closed = isinstance(source, FrameSource), threading.Event()
        self.name, self.uri = str(getattr(source, "name", "")), str(getattr(source, "uri", ""))

    @property
    def dropped(self) -> int:
        """Return the number of frames that a camera lost; 0 for a log."""
        return self._source.dropped if isinstance(self._source, FrameSource) else 0

    def __iter__(self) -> Iterator[Frame]:
        for frame in self._source:
            if self._closed.is_set():
                return
            try:
                yield self._mask(frame, live=self._live)
            except JointsUnknownError:
                continue  # the mask counts and reports it

    def close(self) -> None:
        """End the stream."""
        self._closed.set()
        if isinstance(self._source, FrameSource):
            self._source.close()

"""Logs of a wrist or static camera with the robot's own body masked out."""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator, Mapping
from functools import cached_property, partial
from pathlib import Path
from typing import Protocol, TypeGuard, runtime_checkable

from numpy.typing import ArrayLike

from splatbot.errors import FormatError, InputError, LogError
from splatbot.frame import Frame
from splatbot.layouts import log_kind
from splatbot.logs import Log, open_log
from splatbot.logs.rig import RigCamera, RigLog
from splatbot.logs.ros_transforms import StampedTransform
from splatbot.mapping.selfmask import JointsUnknownError, SelfMask
from splatbot.protocols import RobotKinematics
from splatbot.results.folder import RunFolder
from splatbot.robots.joint_offsets import robot_in_scene
from splatbot.robots.link_poses import LinkPoses
from splatbot.robots.robot import RobotModel
from splatbot.robots.store import load_robot
from splatbot.robots.tf_buffer import TransformBuffer
from splatbot.run.masked import MaskedLog
from splatbot.workspace import NAME, Workspace, find_workspace

MAX_RECORDED = 5_000_000
"""Largest number of transforms of a recording: 320 MB, ten minutes of eight links at 1 kHz."""


def self_mask(
    robot: RobotKinematics,
    workspace: Workspace | None,
    *,
    held: ArrayLike | None = None,
    file: str | Path = NAME,
    needs_camera: bool = True,
) -> SelfMask:
    """Return the mask of a robot for the camera that a workspace describes.

    Args:
        robot: the robot.
        workspace: camera on its link, and the joints' names and offsets.
        held: (A, 4) spheres (x, y, z, radius) [m] of an object in the hand, in the frame of the last link.
        file: origin of the workspace, for messages.
        needs_camera: refuse a workspace without the pose of the camera. Otherwise TF must give this pose.

    Raises:
        InputError: the pose of the camera is unknown, or the workspace does not fit the robot.
    """
    workspace = workspace or Workspace()
    if workspace.T_link_camera is None and needs_camera:
        raise InputError(
            "has no T_link_camera.",
            file=file,
            field="T_link_camera",
            hint="write translation and quaternion_wxyz of the camera on its link, and camera_link (-1: the last)",
        )
    return SelfMask(
        robot,
        workspace.T_link_camera,
        link=workspace.camera_link,
        joint_offsets=workspace.joint_offsets,
        joint_names=workspace.joint_names,
        held=held,
    )


def open_without_robot(uri: str, robot: str | None, *, camera: str | None = None) -> Log:
    """Open a log whose frames have the robot masked; without a robot it is opened unchanged.

    Args:
        uri: log whose folder has the joints (``joints.txt`` or a recording of ROS topics) and ``scene.yaml`` with the
            camera's pose on its link. In a recording of ROS topics, TF may replace both.
        robot: name as listed by ``splatbot robot list``, or None.
        camera: intrinsics that replace those of the log.

    Raises:
        InputError: the robot or the pose of its camera is unknown.
        LogError: the log is missing or damaged.
    """
    if robot is None:
        return open_log(uri, camera=camera)
    if log_kind(uri) == "rig":  # each camera has a mount of its own
        return RigLog(uri, lambda address, own: open_without_robot(address, robot, camera=own))
    model, workspace, file = load_robot(robot), find_workspace(uri) or Workspace(), f"{uri}/{NAME}"
    robot_in_scene(model, workspace)  # refuses the joint offsets of another arm
    log = open_log(uri, camera=camera, joint_delay=workspace.joint_delay)
    links = recorded_links(model, {"": workspace}, log).get("")
    mask = self_mask(model, workspace, file=file, needs_camera=links is None)
    return MaskedLog(log, mask if links is None else partial(links.mask, mask))


@runtime_checkable
class LogWithTransforms(Protocol):
    """The part that masks use of a recording of ROS topics, :class:`splatbot.logs.bag.BagLog`."""

    path: Path

    @property
    def has_transforms(self) -> bool:
        """Return whether the recording has messages of TF."""
        ...

    def transforms(self) -> Iterator[StampedTransform]:
        """Yield the transforms of /tf_static, then those of /tf."""
        ...


def has_tf(log: Log) -> TypeGuard[LogWithTransforms]:
    """Return whether a log is a recording with messages of TF."""
    return isinstance(log, LogWithTransforms) and log.has_transforms


def recorded_links(robot: RobotModel, workspaces: Mapping[str, Workspace], log: Log) -> dict[str, RecordedLinks]:
    """Return the links of a robot in the TF of recordings, by the names of the cameras whose recordings have TF.

    Args:
        robot: the robot.
        workspaces: scenes by the names of cameras; that of the first one is empty.
        log: a recording, or a rig of several ones.
    """
    parts = log.parts if isinstance(log, RigLog) else [RigCamera("", log, 0.0)]
    found = {}
    for name, part in zip(("", *log.cameras), parts, strict=True):
        if has_tf(part.log):
            workspace = workspaces.get(name, Workspace())
            found[name] = RecordedLinks(robot, workspace, part.log, time_offset=part.time_offset)
    return found


class RecordedLinks:
    """Masks the robot in the frames of a recording of ROS topics with TF.

    Its joint states at the time of a frame count first. Where they are missing, TF gives the poses of the links at the
    times of colour and depth. It always does if the pose of the camera on its link is not known.

    Args:
        robot: the robot.
        workspace: delay of the joints, and prefix in TF.
        log: the recording.
        time_offset: time [s] that was added to the stamps of the frames.
    """

    def __init__(
        self, robot: RobotModel, workspace: Workspace, log: LogWithTransforms, *, time_offset: float = 0.0
    ) -> None:
        self._robot, self._workspace, self._log = robot, workspace, log
        self._after = workspace.joint_delay - time_offset

    def mask(self, mask: SelfMask, frame: Frame) -> Frame:
        """Return the frame with the robot removed from its mask.

        Raises:
            JointsUnknownError: neither joint states nor TF give the poses of the links at its time.
            LogError: the recording has too many transforms.
        """
        if mask.has_camera:
            try:
                return mask(frame)
            except JointsUnknownError:
                if not self._link_poses:
                    raise
        masked = frame
        for later in {0.0, frame.depth_delay}:
            masked = self._link_poses.mask(mask, masked, frame.stamp + later + self._after)
        return masked

    @cached_property
    def _link_poses(self) -> LinkPoses:
        transforms = TransformBuffer(kept_s=math.inf, most=sys.maxsize)
        for count, one in enumerate(self._log.transforms()):
            if count >= MAX_RECORDED:
                hint = "split the recording, or record /joint_states and write T_link_camera to scene.yaml"
                raise LogError(f"has more than {MAX_RECORDED} transforms.", file=self._log.path, field="/tf", hint=hint)
            transforms.add([one])
        return LinkPoses(self._robot, transforms, self._workspace.tf_prefix)


def reopen_log(run: RunFolder, *, uri: str | None = None, camera: str | None = None) -> Log:
    """Open the log of a run as the run read it, with the same camera and the same masked robot.

    Args:
        run: folder of the run.
        uri: present location of the log, if it was moved.
        camera: intrinsics that replace those of the run.

    Raises:
        FormatError: the folder is damaged or does not name the log.
        LogError: the log is missing or damaged.
    """
    source = run.load_metrics().get("log", {})
    found = uri or source.get("uri")
    if found is None:
        raise FormatError("does not name the log.", file=run.metrics, field="log.uri", hint="give --log LOG")
    return open_without_robot(str(found), source.get("robot"), camera=camera or source.get("camera"))

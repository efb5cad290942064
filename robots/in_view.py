"""Logs of a wrist or static camera with the robot's own body masked out."""

from __future__ import annotations

from pathlib import Path

from numpy.typing import ArrayLike

from splatbot.errors import FormatError, InputError
from splatbot.layouts import log_kind
from splatbot.logs import Log, open_log
from splatbot.logs.rig import RigLog
from splatbot.mapping.selfmask import SelfMask
from splatbot.protocols import RobotKinematics
from splatbot.results.folder import RunFolder
from splatbot.robots.store import load_robot
from splatbot.run.masked import MaskedLog
from splatbot.workspace import NAME, Workspace, find_workspace


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
            camera's pose on its link.
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
    workspace = find_workspace(uri)
    mask = self_mask(load_robot(robot), workspace, file=f"{uri}/{NAME}")
    assert workspace is not None
    return MaskedLog(open_log(uri, camera=camera, joint_delay=workspace.joint_delay), mask)


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

"""Logs of a wrist or static camera with the robot's own body masked out."""

from __future__ import annotations

from splatbot.errors import FormatError, InputError
from splatbot.logs import Log, open_log
from splatbot.mapping.selfmask import SelfMask
from splatbot.results.folder import RunFolder
from splatbot.robots.store import load_robot
from splatbot.run.masked import MaskedLog
from splatbot.workspace import NAME, find_workspace


def without_robot(log: Log, robot: str | None) -> Log:
    """Mask the robot in the frames of a log; without a robot the log is returned unchanged.

    Args:
        log: log whose folder contains ``joints.txt`` and ``scene.yaml`` with the camera's pose on its link.
        robot: name as listed by ``splatbot robot list``, or None.

    Raises:
        InputError: the robot or the pose of its camera is unknown.
    """
    if robot is None:
        return log
    workspace = find_workspace(log.uri)
    if workspace is None or workspace.T_link_camera is None:
        raise InputError(
            "has no T_link_camera.",
            file=f"{log.uri}/{NAME}",
            field="T_link_camera",
            hint="write translation and quaternion_wxyz of the camera on its link, and camera_link (-1: the last)",
        )
    mask = SelfMask(
        load_robot(robot),
        workspace.T_link_camera,
        link=workspace.camera_link,
        joint_offsets=workspace.joint_offsets,
    )
    return MaskedLog(log, mask)


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
    return without_robot(open_log(str(found), camera=camera or source.get("camera")), source.get("robot"))

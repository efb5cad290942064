"""Logs in which a robot sees itself, without its body."""

from __future__ import annotations

from splatbot.errors import FormatError, InputError
from splatbot.logs import Log, open_log
from splatbot.mapping.selfmask import SelfMask
from splatbot.results.folder import RunFolder
from splatbot.robots.store import load_robot
from splatbot.run.masked import MaskedLog
from splatbot.workspace import NAME, find_workspace


def without_robot(log: Log, robot: str | None) -> Log:
    """Return the log with the robot masked in its frames, or the log itself without a robot.

    Args:
        log: its folder holds ``joints.txt`` and ``scene.yaml``, which says where the camera is mounted.
        robot: a name as ``splatbot robot list`` prints it, or None.

    Raises:
        InputError: the robot is unknown, or its camera's mount is.
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
    return MaskedLog(log, SelfMask(load_robot(robot), workspace.T_link_camera, link=workspace.camera_link))


def reopen_log(run: RunFolder, *, uri: str | None = None, camera: str | None = None) -> Log:
    """Open the log of a run as the run read it: with its camera, and with the same robot masked.

    Args:
        run: the folder.
        uri: where the log is now, if it was moved.
        camera: intrinsics instead of those that the run used.

    Raises:
        FormatError: the folder is damaged, or does not say where the log is.
        LogError: the log is gone or damaged.
    """
    source = run.load_metrics().get("log", {})
    found = uri or source.get("uri")
    if found is None:
        raise FormatError("does not say where the log is.", file=run.metrics, field="log.uri", hint="give --log LOG")
    return without_robot(open_log(str(found), camera=camera or source.get("camera")), source.get("robot"))

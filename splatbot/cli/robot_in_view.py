"""``--robot``: a log without the robot's own body."""

from __future__ import annotations

from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from splatbot.logs import Log


def without_robot(log: Log, robot: str | None) -> Log:
    """The log with the robot left out of its frames; the log itself without one.

    Args:
        log: its folder holds ``joints.txt`` and ``scene.yaml``, which says where the camera is mounted.
        robot: a name, as ``splatbot robot list`` tells them, or None.

    Raises:
        InputError: the robot is unknown, or its camera's mount is.
    """
    if robot is None:
        return log
    from splatbot.errors import InputError
    from splatbot.mapping.selfmask import SelfMask
    from splatbot.robots.store import load_robot
    from splatbot.run.masked import MaskedLog
    from splatbot.workspace import NAME, find_workspace

    workspace = find_workspace(log.uri)
    if workspace is None or workspace.T_link_camera is None:
        raise InputError(
            "has no T_link_camera.",
            file=f"{log.uri}/{NAME}",
            field="T_link_camera",
            hint="write translation and quaternion_wxyz of the camera on its link, and camera_link (-1: the last)",
        )
    return MaskedLog(log, SelfMask(load_robot(robot), workspace.T_link_camera, link=workspace.camera_link))

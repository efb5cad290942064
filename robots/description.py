"""Reader of an arm from a robot description of any format."""

from __future__ import annotations

from pathlib import Path

from splatbot.robots.mjcf_reader import read_mjcf
from splatbot.robots.reading import Reading
from splatbot.robots.shapes import Mesh
from splatbot.robots.urdf import parse, read_urdf
from splatbot.robots.visual import visual_meshes


def read_description(path: str | Path, *, tip: str | None = None, slack: float | None = None) -> Reading:
    """Read a serial arm from a URDF, xacro or MJCF file; the root element decides.

    Args:
        path: the file.
        tip: end of the arm: a link (URDF), or a body or site (MJCF). If None, see
            :func:`splatbot.robots.reading.default_tip`.
        slack: see :class:`splatbot.robots.robot.RobotModel` [m]. If None, 2 % of the reach.

    Raises:
        FormatError: the file has another format, has no moving joint, or contains an invalid element.
    """
    file = Path(path)
    if parse(file).tag == "mujoco":
        return read_mjcf(file, tip=tip, slack=slack)
    return read_urdf(file, tip=tip, slack=slack)


def visual_of(path: str | Path, *, tip: str | None = None) -> tuple[Mesh, ...]:
    """Return the visual meshes of an arm, simplified for pictures; those of an MJCF file are all its shapes.

    Args:
        path: the file.
        tip: see :func:`read_description`.

    Raises:
        FormatError: see :func:`read_description`.
    """
    file = Path(path)
    if parse(file).tag == "mujoco":
        return visual_meshes(read_mjcf(file, tip=tip).robot.shapes)
    seen = read_urdf(file, tip=tip, kinds=("visual",)).robot.shapes
    return visual_meshes(seen or read_urdf(file, tip=tip).robot.shapes)

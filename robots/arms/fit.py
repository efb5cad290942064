"""The fit of a shipped arm to the description of its maker."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from splatbot.errors import InputError
from splatbot.protocols import LinkSpheres
from splatbot.robots.arms import ARMS, ShippedArm, description_of
from splatbot.robots.bodies import joined, rounded
from splatbot.robots.containment import uncovered
from splatbot.robots.cover import FINE, cover
from splatbot.robots.description import read_description, visual_of
from splatbot.robots.maker_meshes import ReportProgress
from splatbot.robots.robot import Inertial, RobotModel
from splatbot.robots.shapes import Mesh

_MOUNTING = -0.005  # [m] height of the mounting plane, with a tolerance


def described(name: str) -> RobotModel:
    """Return a shipped arm as its installed description has it, with shapes, and spheres that are not fitted yet.

    Raises:
        InputError: the package of the description is not installed.
    """
    arm = ARMS[name]
    robot = read_description(description_of(arm.source), tip=arm.tip, slack=arm.slack).robot
    joints = robot.joints
    if arm.efforts:
        joints = tuple(replace(j, effort=effort) for j, effort in zip(joints, arm.efforts, strict=True))
    return replace(robot, name=name, joints=joints, home=np.array(arm.home))


def fit_arm(name: str, report_progress: ReportProgress) -> RobotModel:
    """Cover the geometry of a shipped arm link by link (minutes), and prove that the rounded spheres contain it.

    Args:
        name: of :data:`splatbot.robots.arms.ARMS`.
        report_progress: called with a line for each link.

    Raises:
        InputError: a package is not installed, or the proof fails.
    """
    robot, arm, parts = described(name), ARMS[name], []
    inertials = _inertials(arm, robot)  # an error before the work
    for link in sorted({shape.link for shape in robot.shapes}):
        slack = arm.slack if link else arm.base_slack or arm.slack
        parts.append(cover([shape for shape in robot.shapes if shape.link == link], slack, FINE))
        report_progress(f"{robot.joints[link - 1].name if link else 'base'}: {len(parts[-1])} spheres")
    fitted = joined(*parts)
    covering = LinkSpheres(fitted.link, *rounded(fitted.centers, fitted.radii))
    if uncovered(robot.shapes, covering) > 0:
        raise InputError("is not contained after rounding.", field=name, hint="fit with another slack")
    visual = tuple(_mounted(mesh) for mesh in visual_of(description_of(arm.source), tip=arm.tip))
    return replace(robot, covering=covering, inertials=inertials, visual=visual)


def _mounted(mesh: Mesh) -> Mesh:
    """Drop the parts of a base's picture that hang below its mounting plane, as the UR5e's cable."""
    if mesh.link:
        return mesh
    return replace(mesh, faces=mesh.faces[mesh.vertices[mesh.faces, 2].max(axis=1) > _MOUNTING])


def _inertials(arm: ShippedArm, robot: RobotModel) -> tuple[Inertial, ...]:
    """Return the inertias of an arm; those of another description are moved into its frames.

    The links of both descriptions coincide when all joints are at 0.
    """
    if arm.masses is None:
        return robot.inertials
    other = read_description(description_of(arm.masses)).robot
    zero = np.zeros(len(robot))
    T_link_other = np.linalg.inv(robot.fk(zero)) @ other.fk(zero)
    return tuple(
        Inertial.summed([(i.mass, T[:3, :3] @ np.asarray(i.center) + T[:3, 3], T[:3, :3] @ i.inertia @ T[:3, :3].T)])
        for T, i in zip(T_link_other, other.inertials, strict=True)
    )

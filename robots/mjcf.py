"""A robot as a MuJoCo model, from the same source as its spheres: joints, limits, inertias, capsules."""

from __future__ import annotations

import xml.etree.ElementTree as ElementTree
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np

from splatbot.errors import InputError
from splatbot.geometry import rotation_to_quat
from splatbot.protocols import Array
from splatbot.robots.robot import GripperGeometry, RobotModel
from splatbot.robots.shapes import Box, Capsule, Shape


@dataclass(frozen=True)
class DriveConstants:
    """Constants of joints and fingers in MuJoCo models.

    Args:
        damping: [Nm s/rad] damping of arm joints; an estimate.
        finger_mass: [kg] mass of a finger.
        finger_drive: [kg] reflected mass of the drive, an estimate; with the 15 g of a finger alone, contacts are soft.
        finger_gain: [N/m] gain of the fingers' position servo, capped by the gripper's force.
    """

    damping: float = 1.0
    finger_mass: float = 0.015
    finger_drive: float = 0.5
    finger_gain: float = 2000.0


CONSTANTS = DriveConstants()


def to_mjcf(robot: RobotModel) -> str:
    """Write MJCF text: a body for each link, position servos, the home posture as keyframe "home".

    Joints, limits of position and torque, inertias and collision capsules and boxes are the robot's own; meshes are
    replaced by its spheres. Neighbouring links, and those whose spheres meet at home, do not collide.

    Raises:
        InputError: the robot has no inertias.
    """
    if not robot.inertials:
        raise InputError("has no inertias.", field=robot.name, hint="give <inertial> in its URDF")
    root = ElementTree.Element("mujoco", model=robot.name)
    ElementTree.SubElement(root, "compiler", angle="radian", autolimits="true", balanceinertia="true")
    ElementTree.SubElement(root, "option", integrator="implicitfast", impratio="10", cone="elliptic")
    bodies = [ElementTree.SubElement(ElementTree.SubElement(root, "worldbody"), "body", name="link0")]
    actuators = ElementTree.SubElement(root, "actuator")
    for k, joint in enumerate(robot.joints):
        body = ElementTree.SubElement(bodies[k], "body", {"name": f"link{k + 1}", **_pose(joint.T_before_joint)})
        kind = "slide" if joint.prismatic else "hinge"
        ElementTree.SubElement(
            body, "joint", name=joint.name, type=kind, axis="0 0 1", range=_text([joint.lower, joint.upper]),
            damping=_text([CONSTANTS.damping]),
        )  # fmt: skip
        gain = 50.0 * joint.effort  # full torque at 20 mrad
        ElementTree.SubElement(
            actuators, "position", name=joint.name, joint=joint.name, kp=_text([gain]), kv=_text([gain / 10]),
            ctrlrange=_text([joint.lower, joint.upper]), forcerange=_text([-joint.effort, joint.effort]),
        )  # fmt: skip
        bodies.append(body)
    for body, inertial in zip(bodies, robot.inertials, strict=True):
        if inertial.mass <= 0:  # a base, which does not move
            continue
        xx, yy, zz = np.diag(inertial.inertia)
        xy, xz, yz = inertial.inertia[0, 1], inertial.inertia[0, 2], inertial.inertia[1, 2]
        ElementTree.SubElement(
            body, "inertial", pos=_text(inertial.center), mass=_text([inertial.mass]),
            fullinertia=_text([xx, yy, zz, xy, xz, yz]),
        )  # fmt: skip
    _add_geoms(robot, bodies)
    ElementTree.SubElement(bodies[-1], "site", {"name": "tcp", **_pose(robot.T_link_tcp)})
    home = list(robot.home)
    if robot.gripper is not None:
        _add_gripper(root, actuators, bodies[-1], robot.gripper)
        home += [robot.gripper.stroke] * 2
    _exclude(root, robot)
    controls = [*robot.home, *([2 * robot.gripper.stroke] if robot.gripper is not None else [])]
    ElementTree.SubElement(
        ElementTree.SubElement(root, "keyframe"), "key", name="home", qpos=_text(home), ctrl=_text(controls)
    )
    ElementTree.indent(root)
    return ElementTree.tostring(root, encoding="unicode") + "\n"


def _add_geoms(robot: RobotModel, bodies: list[ElementTree.Element]) -> None:
    """Add capsules and boxes, or spheres for links with meshes or without shapes."""
    plain = {shape.link for shape in robot.shapes} - {
        shape.link for shape in robot.shapes if not isinstance(shape, (Capsule, Box))
    }
    for shape in robot.shapes:
        if shape.link in plain:
            ElementTree.SubElement(bodies[shape.link], "geom", _geom(shape))
    spheres = robot.spheres()
    for link, center, radius in zip(spheres.link, spheres.centers, spheres.radii, strict=True):
        if int(link) not in plain:
            ElementTree.SubElement(bodies[link], "geom", type="sphere", size=_text([radius]), pos=_text(center))


def _geom(shape: Shape) -> dict[str, str]:
    if isinstance(shape, Capsule):
        if shape.length == 0:
            return {"type": "sphere", "size": _text([shape.radius]), "pos": _text(shape.start)}
        return {"type": "capsule", "size": _text([shape.radius]), "fromto": _text([*shape.start, *shape.end])}
    if isinstance(shape, Box):
        return {"type": "box", "size": _text(np.asarray(shape.size) / 2), **_pose(shape.T_link_box)}
    raise InputError(f"cannot be written: {type(shape).__name__}.", field="shape", hint="give capsules or boxes")


def _add_gripper(
    root: ElementTree.Element, actuators: ElementTree.Element, hand: ElementTree.Element, gripper: GripperGeometry
) -> None:
    """Add two sliding fingers on one servo with the gripper's force; an equality constraint keeps them symmetric."""
    names = [f"finger{i + 1}" for i in range(2)]
    for name, T in zip(names, gripper.T_link_finger, strict=True):
        body = ElementTree.SubElement(hand, "body", {"name": name, **_pose(T)})
        ElementTree.SubElement(
            body,
            "joint",
            name=name,
            type="slide",
            axis="0 1 0",
            range=_text([0.0, gripper.stroke]),
            damping="10",
            armature=_text([CONSTANTS.finger_drive]),
        )
        inertia = _text([CONSTANTS.finger_mass / 6 * 4e-4] * 3)
        ElementTree.SubElement(
            body, "inertial", pos="0 0.01 0.02", mass=_text([CONSTANTS.finger_mass]), diaginertia=inertia
        )
        for shape in gripper.shapes:
            ElementTree.SubElement(body, "geom", _geom(shape) | {"friction": "1 0.005 0.0001"})
    tendon = ElementTree.SubElement(ElementTree.SubElement(root, "tendon"), "fixed", name="opening")
    for name in names:
        ElementTree.SubElement(tendon, "joint", joint=name, coef="1")
    equality = ElementTree.SubElement(root, "equality")
    ElementTree.SubElement(
        equality, "joint", joint1=names[0], joint2=names[1], solimp="0.95 0.99 0.001", solref="0.005 1"
    )
    ElementTree.SubElement(
        actuators, "position", name="opening", tendon="opening", kp=_text([CONSTANTS.finger_gain]), kv="50",
        ctrlrange=_text([0.0, 2 * gripper.stroke]), forcerange=_text([-gripper.force, gripper.force]),
    )  # fmt: skip


def _exclude(root: ElementTree.Element, robot: RobotModel) -> None:
    tested = {tuple(sorted(pair)) for pair in robot.self_collision_pairs.tolist()}
    contact = ElementTree.SubElement(root, "contact")
    links = len(robot) + 1
    for a in range(links):
        for b in range(a + 1, links):
            if (a, b) not in tested:
                ElementTree.SubElement(contact, "exclude", body1=f"link{a}", body2=f"link{b}")
    for finger in ("finger1", "finger2") if robot.gripper is not None else ():
        for a in range(max(0, links - 3), links):
            ElementTree.SubElement(contact, "exclude", body1=f"link{a}", body2=finger)


def _pose(T: Array) -> dict[str, str]:
    return {"pos": _text(T[:3, 3]), "quat": _text(rotation_to_quat(T[:3, :3]))}


def _text(values: Iterable[float]) -> str:
    return " ".join(f"{float(v):.12g}" for v in values)

"""Two-finger hands, and arms that carry them: Franka's hand, Robotiq's 2F-85 and 2F-140.

The 2F-85 has slim fingers for low or closely spaced objects. The 2F-140 grasps objects wider than 80 mm.

Strokes, forces, masses and the length of the 2F-85 come from Robotiq's data sheets (85 mm, 20 to 235 N, 163 mm; 140 mm,
10 to 125 N). The 2F-85 uses the force of the Panda's hand. Coarse shapes enclose the body, the open linkage and the
fingers. The spheres of Franka's hand contain its meshes; its mass is that of Franka's data sheet.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from splatbot.errors import InputError
from splatbot.geometry import transform_points
from splatbot.protocols import Array, HandShape, LinkSpheres
from splatbot.robots.bodies import joined, load_body
from splatbot.robots.cover import cover
from splatbot.robots.panda import FINGERS, HAND, HAND_TCP, arm_spheres, finger_shapes, hand_shapes, panda
from splatbot.robots.robot import CONSTANTS as COVER
from splatbot.robots.robot import GripperGeometry, Inertial, RobotModel
from splatbot.robots.shapes import Box, Capsule, Mesh, Shape

_FLANGE = 0.107  # [m] of the Panda's last link
_ROOT_2F85 = 0.09  # [m] from the flange to the frame of its fingers
_WRIST = 3  # links before the last one that a hand may touch at home
_TURNED = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Hand:
    """A hand whose two fingers open along the y axis of its tool frame and reach along the z axis.

    Args:
        name: suffix of the name of the robot that carries it.
        T_flange_tcp: (4, 4) pose of the tool frame, which lies between the pads, on the flange [m].
        body: shapes of the hand in the frame of the flange [m]; their ``link`` is ignored.
        T_flange_finger: (2, 4, 4) pose of each closed finger [m]; its y axis points in the direction of opening.
        finger: shapes of one finger in its own frame [m].
        stroke: travel of each finger [m].
        force: force between the fingers [N].
        speed: speed of each finger [m/s].
        mass: of the hand [kg].
        body_covering: spheres of the hand in the frame of the flange. If None, they are generated from ``body``.
        finger_covering: spheres of one finger in its own frame. If None, they are generated from ``finger``.
        box: boxes around fingers and palm. If None, they are measured on the shapes.
    """

    name: str
    T_flange_tcp: Array
    body: Sequence[Shape]
    T_flange_finger: Array
    finger: Sequence[Shape]
    stroke: float
    force: float
    speed: float
    mass: float
    body_covering: LinkSpheres | None = None
    finger_covering: LinkSpheres | None = None
    box: HandShape | None = None


def _along_z(z: float) -> Array:
    T = np.eye(4)
    T[2, 3] = z
    return T


def roots(z: float) -> Array:
    """Return poses (2, 4, 4) of two fingers that face each other, at a distance ``z`` [m] from the flange."""
    return np.stack([_along_z(z) @ turn for turn in (np.eye(4), _TURNED)])


ROBOTIQ_2F140 = Hand(
    "2f140",
    T_flange_tcp=_along_z(0.205),
    body=(
        Capsule(0, (0.0, 0.0, 0.02), (0.0, 0.0, 0.075), 0.045),
        Capsule(0, (0.0, -0.07, 0.105), (0.0, 0.07, 0.105), 0.03),
    ),
    T_flange_finger=roots(0.135),
    finger=(Capsule(0, (0.0, 0.0125, 0.0), (0.0, 0.0125, 0.07), 0.0125),),
    stroke=0.07,
    force=125.0,
    speed=0.15,
    mass=1.025,
)


@cache
def robotiq_2f85() -> Hand:
    """Return Robotiq's 2F-85, whose spheres contain its levers at every opening.

    The tool frame is that of the nearly closed hand. Its pads are 14 mm shorter at 85 mm than closed.
    """
    body = load_body("2f85")
    return Hand(
        "2f85",
        T_flange_tcp=_along_z(0.145),
        body=(
            Capsule(0, (0.0, 0.0, 0.034), (0.0, 0.0, 0.04), 0.034),
            Capsule(0, (0.0, -0.055, 0.085), (0.0, 0.055, 0.085), 0.014),
        ),
        T_flange_finger=roots(_ROOT_2F85),
        # Capsules of the twin, which lie in the spheres: 22 mm wide and, up to 38 mm from their tips, 10 mm thick.
        finger=(
            Capsule(0, (-0.006, 0.005, 0.02), (-0.006, 0.005, 0.068), 0.005),
            Capsule(0, (0.006, 0.005, 0.02), (0.006, 0.005, 0.068), 0.005),
            Capsule(0, (0.0, 0.012, 0.014), (0.0, 0.012, 0.025), 0.008),
        ),
        stroke=0.0425,
        force=70.0,
        speed=0.15,
        mass=0.925,
        body_covering=body.on("hand", 0),
        finger_covering=body.on("finger", 0, _along_z(-_ROOT_2F85)),
        box=HandShape(
            stroke=0.085,
            width=0.022,
            thickness=0.02,
            tip=0.018,
            pad=0.013,
            pad_width=0.012,
            palm=0.04,
            palm_size=(0.075, 0.1485),
            force=70.0,
        ),
    )


@cache
def franka_hand() -> Hand:
    """Return Franka's hand, whose certified body is that of the Panda."""
    body = load_body("panda")
    return Hand(
        "panda_hand",
        T_flange_tcp=_along_z(HAND_TCP),
        body=hand_shapes(),
        T_flange_finger=roots(FINGERS),
        finger=finger_shapes(),
        stroke=0.04,
        force=70.0,
        speed=0.05,
        mass=0.73,
        body_covering=body.on("hand", 0),
        finger_covering=body.on("finger", 0),
        box=HAND,
    )


HAND_NAMES = ("2f85", "2f140", "panda_hand")


def find_hand(name: str) -> Hand:
    """Return a hand by its name.

    Raises:
        InputError: there is no such hand.
    """
    if name not in HAND_NAMES:
        hint = f"grippers: {', '.join(HAND_NAMES)}, or the URDF of a parallel gripper"
        raise InputError(f"is {name!r}.", field="gripper", hint=hint)
    if name == "2f140":
        return ROBOTIQ_2F140
    return robotiq_2f85() if name == "2f85" else franka_hand()


def attach(arm: RobotModel, hand: Hand) -> RobotModel:
    """Attach a hand to the tool frame of an arm, whose z axis points away from the arm.

    The hand is a point mass in the twin. Links of the wrist that it touches at home are not checked against it.

    Args:
        arm: an arm without a gripper.
        hand: the hand.

    Raises:
        InputError: the arm has a gripper.
    """
    last, flange = len(arm), arm.T_link_tcp
    if arm.gripper is not None:
        raise InputError("has a gripper.", field=arm.name, hint="attach a hand to an arm without one")
    body = tuple(moved(shape, flange, last) for shape in hand.body)
    middle = transform_points(flange, hand.T_flange_tcp[:3, 3] / 2)
    parts = [(i.mass, np.asarray(i.center), i.inertia) for i in arm.inertials[-1:]]
    robot = replace(
        arm,
        name=f"{arm.name}-{hand.name}",
        shapes=(*arm.shapes, *body),
        covering=joined(arm.spheres(), _spheres(hand, flange, last)),
        T_link_tcp=flange @ hand.T_flange_tcp,
        gripper=GripperGeometry(
            flange @ hand.T_flange_finger,
            hand.stroke,
            tuple(hand.finger),
            speed=hand.speed,
            force=hand.force,
            covering=hand.finger_covering or cover(hand.finger, COVER.slack / 2),
            hand=hand.box,
        ),
        inertials=(*arm.inertials[:-1], Inertial.summed([*parts, (hand.mass, middle, np.zeros((3, 3)))]))
        if arm.inertials
        else (),
        pairs=None,
    )
    apart = set(map(tuple, robot.self_collision_pairs.tolist()))
    pairs = [(a, b) for a, b in arm.self_collision_pairs.tolist() if (a, b) in apart or a < last - _WRIST]
    return replace(robot, pairs=np.array(pairs, dtype=np.int32).reshape(-1, 2))


@cache
def panda_2f85() -> RobotModel:
    """Return the Panda with the 2F-85."""
    return _panda_with(robotiq_2f85())


@cache
def panda_2f140() -> RobotModel:
    """Return the Panda with the 2F-140."""
    return _panda_with(ROBOTIQ_2F140)


def _panda_with(hand: Hand) -> RobotModel:
    """Build the Panda with another hand; the twin keeps the inertia of the Panda's own."""
    arm = panda()
    own = [shape for shape in arm.shapes if shape.link < 7]
    flange = [shape for shape in arm.shapes if shape.link == 7][:2]
    bare = replace(
        arm,
        shapes=(*own, *flange),
        covering=joined(*arm_spheres()),
        T_link_tcp=_along_z(_FLANGE),
        gripper=None,
    )
    return replace(attach(bare, hand), inertials=arm.inertials)


def _spheres(hand: Hand, T_link_flange: Array, link: int) -> LinkSpheres:
    """Return the spheres of a hand's body on a link."""
    own = hand.body_covering
    if own is None:
        return cover([moved(shape, T_link_flange, link) for shape in hand.body], COVER.slack)
    return LinkSpheres(np.full(len(own), link, np.int32), transform_points(T_link_flange, own.centers), own.radii)


def moved(shape: Shape, T_link_flange: Array, link: int) -> Shape:
    """Return a shape of the flange's frame as that of a link."""
    if isinstance(shape, Mesh):
        return replace(shape, link=link, vertices=transform_points(T_link_flange, shape.vertices))
    if isinstance(shape, Box):
        return replace(shape, link=link, T_link_box=T_link_flange @ shape.T_link_box)
    assert isinstance(shape, Capsule)
    start, end = transform_points(T_link_flange, np.array([shape.start, shape.end]))
    return Capsule(link, _point(start), _point(end), shape.radius)


def _point(p: Array) -> tuple[float, float, float]:
    return float(p[0]), float(p[1]), float(p[2])

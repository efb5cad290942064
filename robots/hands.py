"""Two-finger hands, and arms that carry them: Franka's hand, Robotiq's 2F-85 and 2F-140.

The 2F-85 has slim fingers for low or closely spaced objects. The 2F-140 grasps objects wider than 80 mm.

Strokes, forces, masses and the length of the 2F-85 come from Robotiq's data sheets (85 mm, 20 to 235 N, 163 mm; 140 mm,
10 to 125 N). The 2F-85 uses the force of the Panda's hand. Coarse shapes enclose the body, the open linkage and the
fingers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache

import numpy as np

from splatbot.errors import InputError
from splatbot.geometry import transform_points
from splatbot.protocols import Array
from splatbot.robots.bodies import joined
from splatbot.robots.cover import cover
from splatbot.robots.panda import arm_spheres, panda
from splatbot.robots.robot import CONSTANTS as COVER
from splatbot.robots.robot import GripperGeometry, Inertial, RobotModel
from splatbot.robots.shapes import Capsule

_FLANGE = 0.107  # [m] of the Panda's last link
_Along = tuple[tuple[float, float, float], tuple[float, float, float], float]  # ends and radius of a capsule [m]
_WRIST = 3  # links before the last one that a hand may touch at home
_TURNED = np.diag([-1.0, -1.0, 1.0, 1.0])


@dataclass(frozen=True, eq=False)
class Hand:
    """A hand whose two fingers open along the y axis of its flange and reach along the z axis.

    Args:
        name: suffix of the name of the robot that carries it.
        tcp: distance of the tool frame, which lies between the pads, from the flange [m].
        body: capsules of the hand in the frame of the flange [m].
        root: distance of the roots of the fingers from the flange [m].
        finger: capsules of one finger in its own frame [m].
        stroke: travel of each finger [m].
        force: force between the fingers [N].
        speed: speed of each finger [m/s].
        mass: of the hand [kg].
    """

    name: str
    tcp: float
    body: Sequence[_Along]
    root: float
    finger: Sequence[_Along]
    stroke: float
    force: float
    speed: float
    mass: float


ROBOTIQ_2F85 = Hand(
    "2f85",
    tcp=0.145,
    body=(((0.0, 0.0, 0.02), (0.0, 0.0, 0.06), 0.04), ((0.0, -0.05, 0.085), (0.0, 0.05, 0.085), 0.02)),
    root=0.09,
    # 22 mm wide and, up to 38 mm from their tips, 10 mm thick with round edges. Checks with the target use boxes of the
    # thickness at the roots, 20 mm.
    finger=(
        ((-0.006, 0.005, 0.0), (-0.006, 0.005, 0.068), 0.005),
        ((0.006, 0.005, 0.0), (0.006, 0.005, 0.068), 0.005),
        ((0.0, 0.01, 0.0), (0.0, 0.01, 0.025), 0.01),
    ),
    stroke=0.0425,
    force=70.0,
    speed=0.15,
    mass=0.925,
)
ROBOTIQ_2F140 = Hand(
    "2f140",
    tcp=0.205,
    body=(((0.0, 0.0, 0.02), (0.0, 0.0, 0.075), 0.045), ((0.0, -0.07, 0.105), (0.0, 0.07, 0.105), 0.03)),
    root=0.135,
    finger=(((0.0, 0.0125, 0.0), (0.0, 0.0125, 0.07), 0.0125),),
    stroke=0.07,
    force=125.0,
    speed=0.15,
    mass=1.025,
)
HANDS = {hand.name: hand for hand in (ROBOTIQ_2F85, ROBOTIQ_2F140)}


def find_hand(name: str) -> Hand:
    """Return a hand by its name.

    Raises:
        InputError: there is no such hand.
    """
    if name not in HANDS:
        raise InputError(f"is {name!r}.", field="gripper", hint=f"grippers: {', '.join(HANDS)}")
    return HANDS[name]


def attach(arm: RobotModel, name: str) -> RobotModel:
    """Attach a hand to the tool frame of an arm, whose z axis points away from the arm.

    The hand is a point mass in the twin. Links of the wrist that it touches at home are not checked against it.

    Args:
        arm: an arm without a gripper.
        name: of :data:`HANDS`.

    Raises:
        InputError: there is no such hand, or the arm has a gripper.
    """
    hand, last, flange = find_hand(name), len(arm), arm.T_link_tcp
    if arm.gripper is not None:
        raise InputError("has a gripper.", field=arm.name, hint="attach a hand to an arm without one")
    body = _moved(hand.body, flange, last)
    finger = tuple(Capsule(0, *along) for along in hand.finger)
    middle = transform_points(flange, np.array([0.0, 0.0, hand.tcp / 2]))
    parts = [(i.mass, np.asarray(i.center), i.inertia) for i in arm.inertials[-1:]]
    robot = replace(
        arm,
        name=f"{arm.name}-{hand.name}",
        shapes=(*arm.shapes, *body),
        covering=joined(arm.spheres(), cover(body, COVER.slack)),
        T_link_tcp=flange @ _along_z(hand.tcp),
        gripper=GripperGeometry(
            np.stack([flange @ _along_z(hand.root) @ turn for turn in (np.eye(4), _TURNED)]),
            hand.stroke,
            finger,
            speed=hand.speed,
            force=hand.force,
            covering=cover(finger, COVER.slack / 2),
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
    return _panda_with(ROBOTIQ_2F85)


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
    return replace(attach(bare, hand.name), inertials=arm.inertials)


def _moved(capsules: Sequence[_Along], T_link_flange: Array, link: int) -> tuple[Capsule, ...]:
    """Return capsules of the flange's frame as those of a link."""
    found = []
    for a, b, radius in capsules:
        start, end = transform_points(T_link_flange, np.array([a, b]))
        found.append(Capsule(link, _point(start), _point(end), radius))
    return tuple(found)


def _point(p: Array) -> tuple[float, float, float]:
    return float(p[0]), float(p[1]), float(p[2])


def _along_z(z: float) -> Array:
    T = np.eye(4)
    T[2, 3] = z
    return T

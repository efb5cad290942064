"""The Panda with a Robotiq 2F-85 or 2F-140 instead of its hand.

The 2F-85 has slim fingers for low or closely spaced objects. The 2F-140 grasps objects wider than 80 mm.

Strokes, forces and the length of the 2F-85 come from Robotiq's data sheets (85 mm, 20 to 235 N, 163 mm; 140 mm, 10 to
125 N). The 2F-85 uses the force of the Panda's hand. Coarse shapes enclose the body, the open linkage and the fingers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from splatbot.protocols import Array
from splatbot.robots.bodies import joined
from splatbot.robots.cover import cover
from splatbot.robots.panda import arm_spheres, panda
from splatbot.robots.robot import CONSTANTS as COVER
from splatbot.robots.robot import GripperGeometry, RobotModel
from splatbot.robots.shapes import Capsule

_FLANGE = 0.107  # [m] of the last link
_Along = tuple[tuple[float, float, float], tuple[float, float, float], float]  # ends and radius of a capsule [m]


@cache
def panda_2f85() -> RobotModel:
    """Return the arm with the 2F-85.

    The fingers are 22 mm wide and, up to 38 mm from their tips, 10 mm thick with round edges. Collision checks with the
    target use boxes of the thickness at the roots of the fingers, 20 mm.
    """
    return _with_hand(
        "panda-2f85",
        tcp=0.145,
        body=(((0.0, 0.0, 0.02), (0.0, 0.0, 0.06), 0.04), ((0.0, -0.05, 0.085), (0.0, 0.05, 0.085), 0.02)),
        root=0.09,
        finger=(
            ((-0.006, 0.005, 0.0), (-0.006, 0.005, 0.068), 0.005),
            ((0.006, 0.005, 0.0), (0.006, 0.005, 0.068), 0.005),
            ((0.0, 0.01, 0.0), (0.0, 0.01, 0.025), 0.01),
        ),
        stroke=0.0425,
        force=70.0,
    )


@cache
def panda_2f140() -> RobotModel:
    """Return the arm with the 2F-140."""
    return _with_hand(
        "panda-2f140",
        tcp=0.205,
        body=(((0.0, 0.0, 0.02), (0.0, 0.0, 0.075), 0.045), ((0.0, -0.07, 0.105), (0.0, 0.07, 0.105), 0.03)),
        root=0.135,
        finger=(((0.0, 0.0125, 0.0), (0.0, 0.0125, 0.07), 0.0125),),
        stroke=0.07,
        force=125.0,
    )


def _with_hand(
    name: str, *, tcp: float, body: Sequence[_Along], root: float, finger: Sequence[_Along], stroke: float, force: float
) -> RobotModel:
    """Build the Panda with another hand.

    Args:
        name: name of the robot.
        tcp: distance of the tool frame, which lies between the pads, from the flange [m].
        body: capsules of the hand.
        root: distance of the roots of the fingers from the flange [m].
        finger: capsules of one finger in its own frame.
        stroke: travel of each finger along the y axis of the tool [m].
        force: force between the fingers [N].
    """
    arm = panda()
    T_link_flange = _along_z(_FLANGE)
    own = tuple(shape for shape in arm.shapes if shape.link < 7)
    flange = tuple(shape for shape in arm.shapes if shape.link == 7)[:2]
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    hand = tuple(Capsule(7, _at(*a), _at(*b), radius) for a, b, radius in body)
    return replace(
        arm,
        name=name,
        shapes=(*own, *flange, *hand),
        covering=joined(*arm_spheres(), cover(hand, COVER.slack)),
        T_link_tcp=T_link_flange @ _along_z(tcp),
        gripper=GripperGeometry(
            np.stack([T_link_flange @ _along_z(root) @ turn for turn in (np.eye(4), turned)]),
            stroke,
            tuple(Capsule(0, *along) for along in finger),
            speed=0.15,
            force=force,
            covering=cover([Capsule(0, *along) for along in finger], COVER.slack / 2),
        ),
    )


def _along_z(z: float) -> Array:
    T = np.eye(4)
    T[2, 3] = z
    return T


def _at(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Transform a point from the flange to the last link."""
    return x, y, z + _FLANGE

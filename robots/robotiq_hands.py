"""The Panda with a Robotiq 2F-85 or 2F-140 in place of its hand. They are slim fingers for low or close
objects, and a hand for objects wider than 80 mm.

Strokes, forces and the length of the 2F-85 are from Robotiq's data sheets (85 mm, 20 to 235 N, 163 mm; 140 mm, 10 to
125 N). The 2F-85 presses as the Panda's hand does. The shapes are coarse ones around body, open linkage and fingers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache

import numpy as np

from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.robots.robot import GripperGeometry, RobotModel
from splatbot.robots.shapes import Capsule

_FLANGE = 0.107  # [m] of the last link
_Along = tuple[tuple[float, float, float], tuple[float, float, float], float]  # ends and radius of a capsule [m]


@cache
def panda_2f85() -> RobotModel:
    """Return the arm with the slim fingers, 22 mm wide and, for 38 mm from their tips, 10 mm thick with round edges.

    Against the target itself its fingers count as boxes as thick as they are at their roots, 20 mm.
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
    """Return the arm with the wide hand."""
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
    """Build the Panda with a hand whose fingers begin ``root`` [m] from the flange.

    The tool's frame lies between its pads, ``tcp`` [m] from the flange; they open along its y, ``stroke`` [m] each.
    """
    arm = panda()
    T_link_flange = _along_z(_FLANGE)
    own = tuple(shape for shape in arm.shapes if shape.link < 7)
    flange = tuple(shape for shape in arm.shapes if shape.link == 7)[:2]
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    return replace(
        arm,
        name=name,
        shapes=(*own, *flange, *(Capsule(7, _at(*a), _at(*b), radius) for a, b, radius in body)),
        T_link_tcp=T_link_flange @ _along_z(tcp),
        gripper=GripperGeometry(
            np.stack([T_link_flange @ _along_z(root) @ turn for turn in (np.eye(4), turned)]),
            stroke,
            tuple(Capsule(0, *along) for along in finger),
            speed=0.15,
            force=force,
        ),
    )


def _along_z(z: float) -> Array:
    T = np.eye(4)
    T[2, 3] = z
    return T


def _at(x: float, y: float, z: float) -> tuple[float, float, float]:
    """Return a point of the flange on the last link."""
    return x, y, z + _FLANGE

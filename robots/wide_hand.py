"""The Panda with a Robotiq 2F-140 in place of its hand, for things that are wider than 80 mm.

Stroke and force from Robotiq's data sheet (140 mm, 125 N); the shapes are coarse ones around its body, the linkage when
open, and the fingers.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np

from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.robots.robot import Gripper, RobotModel
from splatbot.robots.shapes import Capsule

_FLANGE = 0.107  # [m] of the last link
_TCP = 0.205  # [m] from the flange to between the pads
_FINGER = (0.135, 0.205)  # [m] from where to where the middle of a finger's tip goes
_THICK = 0.0125  # [m] half of a finger's width and thickness
_BODY = ((0.0, 0.0, 0.02), (0.0, 0.0, 0.075), 0.045)
_LINKAGE = ((0.0, -0.07, 0.105), (0.0, 0.07, 0.105), 0.03)


@cache
def panda_2f140() -> RobotModel:
    """The arm with the wide hand; the tool's frame lies between its pads, which open along y."""
    arm = panda()
    T_link_flange = _along_z(_FLANGE)
    wide = (
        Capsule(7, _at(*_BODY[0]), _at(*_BODY[1]), _BODY[2]),
        Capsule(7, _at(*_LINKAGE[0]), _at(*_LINKAGE[1]), _LINKAGE[2]),
    )
    own = tuple(shape for shape in arm.shapes if shape.link < 7)
    flange = tuple(shape for shape in arm.shapes if shape.link == 7)[:2]
    finger = Capsule(0, (0.0, _THICK, 0.0), (0.0, _THICK, _FINGER[1] - _FINGER[0]), _THICK)
    turned = np.diag([-1.0, -1.0, 1.0, 1.0])
    return replace(
        arm,
        name="panda-2f140",
        shapes=(*own, *flange, *wide),
        T_link_tcp=T_link_flange @ _along_z(_TCP),
        gripper=Gripper(
            np.stack([T_link_flange @ _along_z(_FINGER[0]) @ turn for turn in (np.eye(4), turned)]),
            0.07,
            (finger,),
            speed=0.15,
            force=125.0,
        ),
    )


def _along_z(z: float) -> Array:
    T = np.eye(4)
    T[2, 3] = z
    return T


def _at(x: float, y: float, z: float) -> tuple[float, float, float]:
    """A point of the flange on the last link."""
    return x, y, z + _FLANGE

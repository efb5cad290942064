"""Franka Emika Panda with its hand: published kinematics and limits, estimated inertias, certified body.

DH parameters and limits come from Franka's documentation (robot and interface specifications). Inertias are those of
Gaz et al. (Dynamic Identification of the Franka Emika Panda Robot, RA-L 2019). The spheres contain Franka's visual and
collision meshes; see :mod:`splatbot.robots.bodies`. The capsules of the twin lie in these meshes.
"""

from __future__ import annotations

from functools import cache

import numpy as np

from splatbot.protocols import Array, HandShape, LinkSpheres
from splatbot.robots.bodies import joined, load_body
from splatbot.robots.joints import Joint
from splatbot.robots.link_frames import LinkFrames
from splatbot.robots.robot import GripperGeometry, Inertial, RobotModel
from splatbot.robots.shapes import Capsule

# Modified DH (Craig): a [m], d [m], alpha [rad] of the frame of each joint in the previous frame.
_DH = (
    (0.0, 0.333, 0.0),
    (0.0, 0.0, -np.pi / 2),
    (0.0, 0.316, np.pi / 2),
    (0.0825, 0.0, np.pi / 2),
    (-0.0825, 0.384, -np.pi / 2),
    (0.0, 0.0, np.pi / 2),
    (0.088, 0.0, np.pi / 2),
)
_LOWER = (-2.8973, -1.7628, -2.8973, -3.0718, -2.8973, -0.0175, -2.8973)
_UPPER = (2.8973, 1.7628, 2.8973, -0.0698, 2.8973, 3.7525, 2.8973)
_VELOCITY = (2.1750, 2.1750, 2.1750, 2.1750, 2.6100, 2.6100, 2.6100)
_ACCELERATION = (15.0, 7.5, 10.0, 12.5, 15.0, 20.0, 20.0)
_JERK = (7500.0, 3750.0, 5000.0, 6250.0, 7500.0, 10000.0, 10000.0)
_EFFORT = (87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0)
_FLANGE, _HAND_YAW = 0.107, -np.pi / 4  # [m] and [rad]
FINGERS, HAND_TCP = 0.0584, 0.1034
"""Distances of the roots of the fingers and of the tool frame from the flange of the hand [m]."""
_HOME = (0.0, -0.3, 0.0, -2.2, 0.0, 2.0, np.pi / 4)

# Mass, centre, and inertia (xx, yy, zz, xy, xz, yz) of the links 0..7, the hand with link 7.
_INERTIALS = (
    (2.92, (-0.025566, -2.88e-05, 0.057332), (0.00782, 0.0109, 0.0102, -1.56e-05, -0.00126, 1.08e-06)),
    (4.970684, (0.003875, 0.002081, -0.1750), (0.70337, 0.70661, 0.009117, -0.000139, 0.006772, 0.019169)),
    (0.646926, (-0.003141, -0.02872, 0.003495), (0.007962, 0.02811, 0.025995, -0.003925, 0.010254, 0.000704)),
    (3.228604, (0.027518, 0.039252, -0.066502), (0.037242, 0.036155, 0.01083, -0.004761, -0.011396, -0.012805)),
    (3.587895, (-0.05317, 0.104419, 0.027454), (0.025853, 0.019552, 0.028323, 0.007796, -0.001332, 0.008641)),
    (1.225946, (-0.011953, 0.041065, -0.038437), (0.035549, 0.029474, 0.008627, -0.002117, -0.004037, 0.000229)),
    (1.666555, (0.060149, -0.014117, -0.010517), (0.001964, 0.004354, 0.005433, 0.000109, -0.001158, 0.000341)),
    (1.495522, (0.0102, -0.0021, 0.0972), (0.0192, 0.0184, 0.0068, -0.0004, -0.0012, -0.0007)),
)

HAND = HandShape(
    stroke=0.08,
    width=0.025,
    thickness=0.0265,
    tip=0.0088999,
    pad=-0.0037,
    pad_width=0.0,
    palm=0.0374,
    palm_size=(0.0634, 0.208),
)
"""Boxes around the meshes of hand and fingers; the pads are those of the twin's fingers."""

# Links that may not touch. Neighbours always do, and so do their spheres.
PAIRS = tuple((a, b) for a in range(8) for b in range(a + 2, 8))


@cache
def panda() -> RobotModel:
    """Return the arm with its hand; the tool frame lies between the finger tips."""
    joints = tuple(
        Joint(
            f"panda_joint{k + 1}",
            _dh(*_DH[k]),
            _LOWER[k],
            _UPPER[k],
            _VELOCITY[k],
            _ACCELERATION[k],
            _JERK[k],
            _EFFORT[k],
        )
        for k in range(7)
    )
    body = load_body("panda")
    return RobotModel(
        name="panda",
        joints=joints,
        shapes=(*_arm_shapes(), *hand_shapes(7, T_LINK_HAND)),
        T_link_tcp=T_LINK_HAND @ _turned(0.0, HAND_TCP),
        home=np.array(_HOME),
        inertials=tuple(Inertial(m, c, _symmetric(i)) for m, c, i in _INERTIALS),
        gripper=GripperGeometry(
            np.stack([T_LINK_HAND @ _turned(yaw, FINGERS) for yaw in (0.0, np.pi)]),
            0.04,
            finger_shapes(),
            covering=body.on("finger", 0),
            hand=HAND,
        ),
        slack=body.slack,
        covering=joined(*arm_spheres(), body.on("hand", 7, T_LINK_HAND)),
        pairs=np.array(PAIRS, dtype=np.int32),
        link_frames=LinkFrames(tuple(f"panda_link{k}" for k in range(8)), np.tile(np.eye(4), (8, 1, 1))),
    )


def arm_spheres() -> list[LinkSpheres]:
    """Return the spheres of the arm without a hand, a link each."""
    body = load_body("panda")
    return [body.on(f"link{k}", k) for k in range(8)]


def _arm_shapes() -> list[Capsule]:
    """Return capsules for the twin. They lie in the meshes of their links, and so in the certified body."""
    return [
        Capsule(0, (-0.034, -0.004, 0.072), (0.004, 0.003, 0.063), 0.058),
        Capsule(0, (-0.095, -0.001, 0.035), (-0.019, -0.045, 0.037), 0.034),
        Capsule(1, (-0.001, -0.051, -0.01), (-0.004, -0.002, -0.138), 0.050),
        Capsule(1, (0.01, -0.019, -0.133), (-0.006, -0.084, 0.002), 0.043),
        Capsule(1, (-0.01, -0.015, -0.05), (0.005, -0.029, 0.004), 0.041),
        Capsule(2, (-0.002, -0.114, 0.019), (-0.001, 0.004, 0.038), 0.050),
        Capsule(2, (-0.011, -0.148, 0.008), (-0.006, 0.006, 0.08), 0.042),
        Capsule(3, (0.025, 0.008, -0.061), (0.086, 0.047, -0.003), 0.048),
        Capsule(3, (0.074, 0.059, 0.0), (0.012, 0.016, -0.074), 0.046),
        Capsule(3, (0.033, 0.018, -0.024), (-0.008, -0.008, -0.079), 0.040),
        Capsule(4, (-0.065, 0.074, 0.014), (-0.017, 0.012, 0.044), 0.049),
        Capsule(4, (-0.005, 0.005, 0.047), (-0.05, 0.042, 0.016), 0.051),
        Capsule(4, (-0.082, 0.056, -0.002), (-0.037, 0.056, 0.02), 0.045),
        Capsule(5, (0.002, 0.061, -0.025), (-0.002, 0.007, -0.208), 0.047),
        Capsule(5, (-0.009, 0.04, -0.172), (-0.004, 0.085, 0.005), 0.039),
        Capsule(5, (-0.016, 0.033, -0.013), (-0.016, -0.015, -0.223), 0.030),
        Capsule(6, (0.081, 0.007, 0.001), (-0.005, -0.008, 0.015), 0.037),
        Capsule(6, (0.088, 0.035, 0.0), (0.038, -0.01, 0.01), 0.039),
        Capsule(7, (-0.019, -0.017, 0.081), (0.036, 0.024, 0.079), 0.022),
        Capsule(7, (-0.01, 0.017, 0.077), (0.02, 0.042, 0.079), 0.021),
    ]


def hand_shapes(link: int = 0, T_link_hand: Array | None = None) -> tuple[Capsule, ...]:
    """Return a capsule in the body of the hand, which has the pose ``T_link_hand`` (4, 4) on a link."""
    T = np.eye(4) if T_link_hand is None else T_link_hand
    start, end = (T @ np.array([0.0, y, 0.04, 1.0]) for y in (-0.064, 0.064))
    return (Capsule(link, (start[0], start[1], start[2]), (end[0], end[1], end[2]), 0.022),)


def finger_shapes() -> tuple[Capsule, ...]:
    """Return the capsule of one finger in its own frame."""
    return (Capsule(0, (0.0, 0.0125, 0.0), (0.0, 0.0125, 0.0413), 0.0125),)


def _dh(a: float, d: float, alpha: float) -> Array:
    """Return Rot_x(alpha) Trans_x(a) Trans_z(d) (Craig 1986)."""
    c, s = np.cos(alpha), np.sin(alpha)
    return np.array([[1, 0, 0, a], [0, c, -s, -s * d], [0, s, c, c * d], [0, 0, 0, 1.0]])


def _turned(yaw: float, z: float) -> Array:
    c, s = np.cos(yaw), np.sin(yaw)
    return np.array([[c, -s, 0, 0], [s, c, 0, 0], [0, 0, 1, z], [0, 0, 0, 1.0]])


def _symmetric(i: tuple[float, ...]) -> Array:
    xx, yy, zz, xy, xz, yz = i
    return np.array([[xx, xy, xz], [xy, yy, yz], [xz, yz, zz]])


T_LINK_HAND = _turned(_HAND_YAW, _FLANGE)
"""Pose (4, 4) of the hand on the last link [m]."""

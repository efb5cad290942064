"""Names and places of the frames that a robot's driver publishes for its links in TF."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatbot.protocols import Array
from splatbot.robots.arms import ARMS
from splatbot.robots.hands import HAND_NAMES
from splatbot.robots.reading import z_to
from splatbot.robots.robot import RobotModel

# Links of the makers' descriptions from the base outwards, and the joint axes in the frames of the links 1..J.
_Z = (0.0, 0.0, 1.0)
_UR = ("shoulder_link", "upper_arm_link", "forearm_link", "wrist_1_link", "wrist_2_link", "wrist_3_link")
_SO100 = ("base", "shoulder", "upper_arm", "lower_arm", "wrist", "gripper", "jaw")
_X, _Y, _MINUS_Y = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, -1.0, 0.0)
_LINKS: dict[str, tuple[tuple[str, ...], tuple[tuple[float, float, float], ...]]] = {
    "panda": (tuple(f"panda_link{k}" for k in range(8)), (_Z,) * 7),
    "ur5e": (("base_link", *_UR), (_Z,) * 6),
    "xarm6": (("link_base", *(f"link{k}" for k in range(1, 7))), (_Z,) * 6),
    "xarm7": (("link_base", *(f"link{k}" for k in range(1, 8))), (_Z,) * 7),
    "iiwa14": (("base_link", *(f"link_{k}" for k in range(1, 8))), (_Z, _Y, _Z, _MINUS_Y, _Z, _Y, _Z)),
    "so100": (_SO100, (_Y, _X, _X, _X, _Y, _Z)),
}


@dataclass(frozen=True, eq=False)
class LinkFrames:
    """Frames of a robot's links in TF.

    Args:
        names: (J + 1) names from the base outwards.
        T_frame_link: (J + 1, 4, 4) poses of the model's links in these frames [m]. In the model each joint turns
            about z.
    """

    names: tuple[str, ...]
    T_frame_link: Array


def link_frames(robot: RobotModel, joint_names: Sequence[str] = ()) -> LinkFrames | None:
    """Return the frames of a shipped robot's links; None for an added robot, whose file does not name its links.

    Args:
        robot: the robot.
        joint_names: (J,) names of its joints. If they are those of the model with a prefix (``left_``), the names of
            the frames have it too.
    """
    arm = next((arm for arm in _LINKS if robot.name == arm or robot.name in _with_hands(arm)), None)
    if arm is None:
        return None
    names, axes = _LINKS[arm]
    prefix = _prefix(joint_names, robot.chain.names)
    T = np.tile(np.eye(4), (len(names), 1, 1))
    T[1:, :3, :3] = [z_to(np.array(axis)) for axis in axes]
    return LinkFrames(tuple(prefix + name for name in names), T)


def _with_hands(arm: str) -> tuple[str, ...]:
    hands = ARMS[arm].hands if arm in ARMS else HAND_NAMES
    return tuple(f"{arm}-{hand}" for hand in hands)


def _prefix(names: Sequence[str], own: Sequence[str]) -> str:
    """Return the prefix of all names before the robot's own; empty if they differ in other ways."""
    if len(names) != len(own) or not names[0].endswith(own[0]):
        return ""
    prefix = names[0].removesuffix(own[0])
    return prefix if all(name == prefix + known for name, known in zip(names, own, strict=True)) else ""

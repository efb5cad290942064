"""What the core asks of a robot: its kinematics and the spheres that stand for its links."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class KinematicChain:
    """A serial arm of J joints. Link 0 is the base; link k moves with joint k - 1. Joints turn about, or move along, z.

    Args:
        names: of the joints.
        T_before_joint: (J, 4, 4), pose of each joint's frame at 0 in the frame of the link before [m].
        prismatic: (J,), the others are revolute.
        lower, upper: (J,) limits [rad or m].
        velocity, acceleration, jerk: (J,) largest magnitudes, in units of lower per s, s² and s³.
        effort: (J,) largest torque [Nm] or force [N].
    """

    names: tuple[str, ...]
    T_before_joint: Array
    prismatic: NDArray[np.bool_]
    lower: Array
    upper: Array
    velocity: Array
    acceleration: Array
    jerk: Array
    effort: Array

    def __len__(self) -> int:
        return len(self.names)


@dataclass(frozen=True, eq=False)
class LinkSpheres:
    """S spheres that cover an arm, sorted by link.

    Args:
        link: (S,) int32.
        centers: (S, 3) in the link's frame [m].
        radii: (S,) [m].
    """

    link: NDArray[np.int32]
    centers: Array
    radii: Array

    def __len__(self) -> int:
        return len(self.link)


@runtime_checkable
class RobotKinematics(Protocol):
    """An arm as collision checking and planning see it."""

    @property
    def name(self) -> str:
        """As the user calls it."""
        ...

    @property
    def chain(self) -> KinematicChain:
        """Joints and their limits."""
        ...

    @property
    def self_collision_pairs(self) -> NDArray[np.int32]:
        """(M, 2) links that may not touch each other."""
        ...

    def spheres(self, opening: float | None = None) -> LinkSpheres:
        """The spheres with the gripper opened by ``opening`` [m]; None: as wide as it goes."""
        ...

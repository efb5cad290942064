"""Joints of an arm."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from splatbot.errors import InputError
from splatbot.protocols import Array, KinematicChain


@dataclass(frozen=True, eq=False)
class Joint:
    """A joint that rotates about, or translates along, the z axis of its own frame.

    Args:
        name: name by the manufacturer.
        T_before_joint: (4, 4) pose of its frame at 0 in the frame of the previous link [m].
        lower, upper: limits [rad or m].
        velocity, acceleration, jerk: largest magnitudes [1/s, 1/s², 1/s³ of those units].
        effort: largest torque [Nm] or force [N].
        prismatic: True for translation along z.

    Raises:
        InputError: a limit is not finite or upper is below lower.
    """

    name: str
    T_before_joint: Array = field(repr=False)
    lower: float
    upper: float
    velocity: float
    acceleration: float
    jerk: float
    effort: float
    prismatic: bool = False

    def __post_init__(self) -> None:
        limits = (self.lower, self.upper, self.velocity, self.acceleration, self.jerk, self.effort)
        if not np.isfinite(limits).all() or self.upper < self.lower or min(limits[2:]) < 0:
            raise InputError(
                f"has limits {limits}.", field=self.name, hint="give finite limits with lower <= upper and rates >= 0"
            )


def chain_of(joints: Sequence[Joint]) -> KinematicChain:
    """Return the kinematic chain of an arm's joints, from the base outwards."""

    def column(name: str) -> Array:
        return np.array([getattr(joint, name) for joint in joints], dtype=np.float64)

    return KinematicChain(
        tuple(joint.name for joint in joints),
        np.array([joint.T_before_joint for joint in joints]),
        np.array([joint.prismatic for joint in joints]),
        *(column(name) for name in ("lower", "upper", "velocity", "acceleration", "jerk", "effort")),
    )

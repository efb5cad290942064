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


def suspect_degrees(q: Array, chain: KinematicChain, field: str) -> None:
    """Check that joint values (J,) are not in degrees: far beyond the limits in radians, but inside in degrees.

    Raises:
        InputError: they are.
    """
    turning = ~chain.prismatic
    radians = np.where(turning, np.radians(q), q)
    beyond = turning & ((q > 2 * np.pi) | (q < -2 * np.pi)) & ((q > chain.upper) | (q < chain.lower))
    if not beyond.any() or ((radians > chain.upper) | (radians < chain.lower)).any():
        return
    k = int(np.flatnonzero(beyond)[0])
    hint = f"give radians: {' '.join(f'{value:.4g}' for value in radians)}"
    limits = f"{chain.lower[k]:.2f} to {chain.upper[k]:.2f} rad"
    raise InputError(f"joint {k} is {q[k]:g}, its limits are {limits}: degrees?", field=field, hint=hint)


def suspect_degrees_in_rows(q: Array, chain: KinematicChain, field: str) -> None:
    """Check each row of joint values (C, J), as :func:`suspect_degrees` does; the error names the row.

    One joint between one and two turns is no reason: joints without limits count their turns.

    Raises:
        InputError: a row is in degrees.
    """
    if q.ndim == 2 and q.shape[1] == len(chain.upper):
        turns = np.abs(q) / (2 * np.pi)
        for row in np.flatnonzero((turns > 2).any(axis=1) | ((turns > 1).sum(axis=1) > 1)):
            suspect_degrees(q[row], chain, f"{field}[{row}]")


def check_limits(q: Array, chain: KinematicChain, field: str) -> None:
    """Check that joint values (J,) [rad or m] are within the limits, as plans do for their ends.

    Raises:
        InputError: one is beyond its limits, or they are degrees.
    """
    suspect_degrees(q, chain, field)
    beyond = chain.beyond_limits(q)
    if beyond is not None:
        k = beyond[0]
        limits = f"{chain.lower[k]:.4g} to {chain.upper[k]:.4g} {'m' if chain.prismatic[k] else 'rad'}"
        problem = f"joint {k} ({chain.names[k]}) is {q[k]:g}, its limits are {limits}."
        raise InputError(problem, field=field, hint="give a value within them")


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

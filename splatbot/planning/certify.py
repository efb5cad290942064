"""Certification of a motion as it will be executed: the curve itself, its limits, and the map of the moment."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import ControllerError
from splatbot.planning.cubics import DEVIATION, CubicPieces
from splatbot.protocols import Array, KinematicChain, TimedPath


@dataclass(frozen=True)
class CertificationConstants:
    """Tolerances of the certification of a motion.

    Args:
        eps: [m] resolution of the certificate of a chord.
        limit_excess: relative excess over a limit that rounding may cause.
        position_excess: [rad or m] excess over a joint limit that rounding may cause.
        rest_velocity: [rad/s or m/s] largest velocity at the ends, and largest step of it between two pieces.
        rest_period: [s] control period within which the jerk limit bounds the acceleration at the ends.
    """

    eps: float = 2e-5
    limit_excess: float = 1e-6
    position_excess: float = 1e-6
    rest_velocity: float = 1e-6
    rest_period: float = 1e-3


CONSTANTS = CertificationConstants()


class MotionRefusedError(ControllerError):
    """A motion is not executed: its curve is not certified where and when it would be."""


class JointCurve(TimedPath, Protocol):
    """A curve in joint space over time whose cubic pieces are known."""

    def pieces(self) -> CubicPieces:
        """Return the cubic pieces of the curve that :meth:`reference` evaluates."""
        ...


@dataclass(frozen=True, eq=False)
class CertifiedMotion:
    """A motion that :func:`certify_motion` found within all limits and free of collisions.

    Controllers follow nothing else.

    Args:
        motion: the curve.
        arm: collision model of the arm at its base, as certified.
        map_version: version of the map, -1 without a map.
    """

    motion: JointCurve
    arm: RobotSpheres
    map_version: int

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return self.motion.duration

    def reference(self, t: float) -> tuple[Array, Array]:
        """Return position and velocity (J,) at a time [s], as :class:`splatbot.protocols.TimedPath` requires."""
        return self.motion.reference(t)

    def recertified(self, field: GaussianCollisionField, *, time: float = 0.0) -> CertifiedMotion:
        """Certify the rest of the motion after a time [s] in a later map.

        Raises:
            MotionRefusedError: the rest is not free.
        """
        _check_free(self.motion.pieces().after(time), self.arm, field)
        return CertifiedMotion(self.motion, self.arm, field.map_version)


def certify_motion(motion: JointCurve, arm: RobotSpheres, field: GaussianCollisionField | None) -> CertifiedMotion:
    """Certify the curve that will be executed.

    1. Positions, velocities, accelerations and jerks keep the limits of the arm (extremes of cubics in closed form).
    2. The arm is at rest at both ends.
    3. Chords that deviate from the curve by at most 0.1 mm are free, with the arm grown by as much.

    Args:
        motion: the curve.
        arm: collision model of the arm, at its base.
        field: map. If None, only self-collision is checked.

    Raises:
        MotionRefusedError: the motion exceeds a limit, does not rest at its ends, or is not free. The message names
            joint and time.
    """
    pieces = motion.pieces()
    chain = arm.robot.chain
    if pieces.position.shape[1] != len(chain):
        text = f"has {pieces.position.shape[1]} joints, {arm.robot.name} has {len(chain)}."
        raise MotionRefusedError(text, field="motion", hint="plan for this robot")
    _check_limits(pieces, chain)
    _check_free(pieces, arm, field)
    return CertifiedMotion(motion, arm, -1 if field is None else field.map_version)


def _check_limits(pieces: CubicPieces, chain: KinematicChain) -> None:
    values = (pieces.time, pieces.position, pieces.acceleration)
    if not all(np.isfinite(value).all() for value in values) or (np.diff(pieces.time) <= 0.0).any():
        raise MotionRefusedError(
            "has values that are not finite.", field="motion", hint="give finite positions and times"
        )
    low, high = pieces.extent()
    outside = np.maximum(chain.lower - low, high - chain.upper)
    if (outside > CONSTANTS.position_excess).any():
        joint = int(np.argmax(outside))
        text = f"takes {chain.names[joint]} {outside[joint]:.4f} beyond its limit."
        raise MotionRefusedError(text, field="motion", hint="keep the whole curve within the joint limits")
    load = pieces.load(chain)
    for row, kind in enumerate(("velocity", "acceleration", "jerk")):
        share = (load.velocity, load.acceleration, load.jerk)[row]
        if not share <= 1.0 + CONSTANTS.limit_excess:
            where = f"{chain.names[load.joint[row]]} at {load.time[row]:.3f} s"
            hint = f"make the motion {load.slowdown:.3f} times as long"
            raise MotionRefusedError(f"needs {share:.3f} times the {kind} limit of {where}.", field="motion", hint=hint)
    v0, v1 = pieces.velocities()
    jumps = np.abs(np.concatenate([v0[:1], v1[:-1] - v0[1:], v1[-1:]]))
    ends = np.abs(pieces.acceleration[[0, -1]])
    if (jumps > CONSTANTS.rest_velocity).any() or (ends > CONSTANTS.rest_period * chain.jerk).any():
        hint = "begin and end at rest, without a step of the velocity"
        raise MotionRefusedError("does not begin and end at rest, or its velocity jumps.", field="motion", hint=hint)


def _check_free(pieces: CubicPieces, arm: RobotSpheres, field: GaussianCollisionField | None) -> None:
    chords = pieces.chords(arm.reach)
    grown = arm.grown(DEVIATION)
    for part, body in ((chords.curved, grown), (~chords.curved, arm)):
        if not part.any():
            continue
        edges = body.certify(field, chords.start[part], chords.end[part], eps=CONSTANTS.eps)
        if edges.in_collision.any():
            first = int(np.argmax(edges.in_collision))
            time = float(pieces.time[chords.first[part][first]])
            text = f"is not certified as free at {time:.3f} s."
            raise MotionRefusedError(text, field="motion", hint="plan again in the map as it is now")

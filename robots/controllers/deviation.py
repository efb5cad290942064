"""Bounds of the deviation of an executed motion from its certified curve."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import ControllerError
from splatbot.planning.cubics import CubicPieces
from splatbot.protocols import Array


@dataclass(frozen=True)
class Deviation:
    """Largest distance between two curves in joint space.

    Args:
        joint: of any joint [rad or m].
        sphere: of any sphere of the arm [m].
    """

    joint: float
    sphere: float

    def __add__(self, other: Deviation) -> Deviation:
        return Deviation(self.joint + other.joint, self.sphere + other.sphere)


@dataclass(frozen=True, eq=False)
class GoalPoints:
    """Points of a trajectory message, at the knots of a certified curve.

    A quintic with the positions, velocities and accelerations of a cubic at both ends is that cubic. Controllers that
    interpolate quintics between these points therefore follow the certified curve up to rounding.

    Args:
        nanoseconds: (N,) increasing times since the start [ns].
        position, velocity, acceleration: (N, J) [rad or m, per s and s²].
    """

    nanoseconds: NDArray[np.int64]
    position: Array
    velocity: Array
    acceleration: Array

    @classmethod
    def of(cls, pieces: CubicPieces) -> GoalPoints:
        """Return the points at the knots of a curve.

        Raises:
            ControllerError: two knots are closer than the resolution of the message, 1 ns.
        """
        nanoseconds = np.rint(pieces.time * 1e9).astype(np.int64)
        if (np.diff(nanoseconds) <= 0).any():
            hint = "give waypoints whose times differ by more than 1 ns"
            raise ControllerError("has knots at the same time.", field="motion", hint=hint)
        velocity = np.zeros_like(pieces.position)  # exactly 0 at the end, where ros2_control refuses a moving arm
        velocity[1:-1] = pieces.velocities()[0][1:]
        return cls(nanoseconds, pieces.position, velocity, pieces.acceleration)


def between_set_points(pieces: CubicPieces, reach: Array, period: float) -> Deviation:
    """Bound the deviation of drives that move straight between set points of the curve.

    With the kernel of linear interpolation, each joint deviates by at most ``period²/8 max |q''|``, and a sphere by at
    most ``period²/8 max Σ reach |q''|``. Accelerations are linear in a piece, so that their sum is largest at a knot.

    Args:
        pieces: the certified curve.
        reach: (K, J), see :attr:`splatbot.collision.RobotSpheres.reach`.
        period: time between set points [s].
    """
    return _largest(period**2 / 8.0 * pieces.acceleration, reach)


def of_quintics(pieces: CubicPieces, points: GoalPoints, reach: Array) -> Deviation:
    """Bound the deviation of the quintics between the points of a message from the certified curve.

    Both are polynomials of degree 5 in the fraction of a piece. Their difference lies in the convex hull of its
    Bernstein coefficients (Farin 2002, ch. 5).

    Args:
        pieces: the certified curve.
        points: one for each knot of the curve.
        reach: (K, J), see :attr:`splatbot.collision.RobotSpheres.reach`.
    """
    v0, v1 = pieces.velocities()
    certified = _bernstein(np.diff(pieces.time), pieces.position, v0, v1, pieces.acceleration)
    h, v = 1e-9 * np.diff(points.nanoseconds), points.velocity
    sent = _bernstein(h, points.position, v[:-1], v[1:], points.acceleration)
    return _largest((sent - certified).reshape(-1, reach.shape[1]), reach)


def _bernstein(h: Array, q: Array, v0: Array, v1: Array, a: Array) -> Array:
    """Return the coefficients (6, K, J) of the quintics with given ends, K pieces of durations h (K,) [s]."""
    h = h[:, None]
    q0, q1, a0, a1 = q[:-1], q[1:], a[:-1], a[1:]
    start = (q0, q0 + h * v0 / 5.0, q0 + 2.0 * h * v0 / 5.0 + h**2 * a0 / 20.0)
    end = (q1 - 2.0 * h * v1 / 5.0 + h**2 * a1 / 20.0, q1 - h * v1 / 5.0, q1)
    return np.stack([*start, *end])


def _largest(moves: Array, reach: Array) -> Deviation:
    size = np.abs(moves)
    return Deviation(float(size.max()), float((size @ reach.T).max()))

"""Cubic pieces of a curve in joint space over time: limits in closed form, and chords of bounded deviation."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.protocols import Array, KinematicChain

DEVIATION = 1e-4  # [m] largest distance between a sphere on the curve and a sphere on the chord that approximates it


@dataclass(frozen=True, eq=False)
class Load:
    """Largest fractions of the limits of an arm that a curve uses, with joint and time of each.

    Args:
        velocity, acceleration, jerk: fraction of the limit; above 1 the limit is exceeded.
        joint: (3,) joint of each of the three.
        time: (3,) start of the piece of each of the three [s].
    """

    velocity: float
    acceleration: float
    jerk: float
    joint: NDArray[np.int64]
    time: Array

    @property
    def slowdown(self) -> float:
        """Factor by which the duration must grow to keep all three limits; 1 if they are kept."""
        return max(1.0, self.velocity, float(np.sqrt(self.acceleration)), float(np.cbrt(self.jerk)))


@dataclass(frozen=True, eq=False)
class CubicPieces:
    """Curve of K cubic pieces with continuous acceleration.

    A piece of duration h from p0 to p1 with the accelerations a0 and a1 at its ends is, with u = t / h::

        q(u) = (1 - u) p0 + u p1 - u (1 - u) / 6 [(2 - u) h² a0 + (1 + u) h² a1]

    Args:
        time: (K + 1,) increasing times of the knots [s].
        position: (K + 1, J) [rad or m].
        acceleration: (K + 1, J) [rad/s² or m/s²].
        line: (K,) number of the straight line on which a piece lies, equal for adjacent pieces of the same line; -1 for
            a curved piece.
    """

    time: Array
    position: Array
    acceleration: Array
    line: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.time) - 1

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return float(self.time[-1])

    def after(self, time: float) -> CubicPieces:
        """Return the pieces that end after a time [s]."""
        first = min(int(np.searchsorted(self.time, time, side="right")) - 1, len(self) - 1)
        first = max(first, 0)
        return CubicPieces(self.time[first:], self.position[first:], self.acceleration[first:], self.line[first:])

    def velocities(self) -> tuple[Array, Array]:
        """Return the velocities (K, J) at the start and at the end of each piece [rad/s or m/s]."""
        h = np.diff(self.time)[:, None]
        mean = np.diff(self.position, axis=0) / h
        a0, a1 = self.acceleration[:-1], self.acceleration[1:]
        return mean - h * (2.0 * a0 + a1) / 6.0, mean + h * (a0 + 2.0 * a1) / 6.0

    def load(self, chain: KinematicChain) -> Load:
        """Return the exact largest fractions of the velocity, acceleration and jerk limits."""
        h = np.diff(self.time)[:, None]
        v0, v1 = self.velocities()
        a0, a1 = self.acceleration[:-1], self.acceleration[1:]
        jerk = (a1 - a0) / h
        with np.errstate(divide="ignore", invalid="ignore"):
            turn = v0 - 0.5 * a0**2 / jerk  # the velocity where the acceleration is 0, if that is inside the piece
        turn = np.where((a0 * a1 < 0.0) & np.isfinite(turn), turn, 0.0)
        shares = (
            np.maximum(np.maximum(np.abs(v0), np.abs(v1)), np.abs(turn)) / chain.velocity,
            np.maximum(np.abs(a0), np.abs(a1)) / chain.acceleration,
            np.abs(jerk) / chain.jerk,
        )
        at = [np.unravel_index(int(np.argmax(share)), share.shape) for share in shares]
        largest = [float(share[where]) for share, where in zip(shares, at, strict=True)]
        joint = np.array([where[1] for where in at], np.int64)
        return Load(largest[0], largest[1], largest[2], joint, self.time[[int(where[0]) for where in at]])

    def extent(self) -> tuple[Array, Array]:
        """Return the exact smallest and largest position (J,) of each joint [rad or m]."""
        h = np.diff(self.time)[:, None]
        s0, s1 = h**2 * self.acceleration[:-1], h**2 * self.acceleration[1:]
        a, b, c = (s1 - s0) / 2.0, s0, np.diff(self.position, axis=0) - s0 / 3.0 - s1 / 6.0  # q' = a u² + b u + c
        # The stable form of the roots: q = -(b + sign(b) √D) / 2, u = q / a and c / q.
        q = -0.5 * (b + np.copysign(np.sqrt(np.maximum(b * b - 4.0 * a * c, 0.0)), b))
        low, high = self.position.min(axis=0), self.position.max(axis=0)
        for top, bottom in ((q, a), (c, q)):
            u = np.divide(top, bottom, out=np.zeros_like(top), where=bottom != 0.0)
            value = self._at(np.clip(u, 0.0, 1.0), slice(None))
            low, high = np.minimum(low, value.min(axis=0)), np.maximum(high, value.max(axis=0))
        return low, high

    def _at(self, u: Array, piece: NDArray[np.int64] | slice) -> Array:
        """Return positions (N, J) at fractions u (N, 1) or (N, J) of pieces (N,)."""
        h = np.diff(self.time)[piece][:, None]
        p0, p1 = self.position[:-1][piece], self.position[1:][piece]
        s0, s1 = h**2 * self.acceleration[:-1][piece], h**2 * self.acceleration[1:][piece]
        value: Array = (1.0 - u) * p0 + u * p1 - u * (1.0 - u) / 6.0 * ((2.0 - u) * s0 + (1.0 + u) * s1)
        return value

    def chords(self, reach: Array) -> Chords:
        """Approximate the curve by chords, such that no sphere deviates from a chord by more than ``DEVIATION``.

        The second derivative is linear in a piece. A chord over a fraction f of a piece of duration h therefore
        deviates by at most ``f²/8 h² max |q''|``. Adjacent pieces on the same line become one chord without deviation.

        Args:
            reach: (K, J), see :attr:`splatbot.collision.RobotSpheres.reach`.
        """
        h = np.diff(self.time)[:, None]
        bend = h**2 * np.maximum(np.abs(self.acceleration[:-1]), np.abs(self.acceleration[1:]))
        moves = (bend / 8.0 @ reach.T).max(axis=1)
        curved = self.line < 0
        parts = np.where(curved, np.maximum(1, np.ceil(np.sqrt(moves / DEVIATION))), 1).astype(np.int64)
        piece = np.repeat(np.arange(len(self)), parts)
        u = (np.arange(len(piece)) - np.repeat(np.cumsum(parts) - parts, parts)) / parts[piece]
        points = np.concatenate([self._at(u[:, None], piece), self.position[-1:]])
        on_line = self.line[piece]
        begins = np.concatenate([[True], curved[piece[1:]] | (on_line[1:] != on_line[:-1])])
        first = np.flatnonzero(begins)
        after = np.append(first[1:], len(piece))
        return Chords(points[first], points[after], piece[first], piece[after - 1], curved[piece[first]])


@dataclass(frozen=True, eq=False)
class Chords:
    """Chords that approximate a curve.

    Args:
        start, end: (N, J) ends of the chords [rad or m].
        first, last: (N,) pieces of the curve in which each chord begins and ends.
        curved: (N,) False if the curve lies on the chord.
    """

    start: Array
    end: Array
    first: NDArray[np.int64]
    last: NDArray[np.int64]
    curved: NDArray[np.bool_]

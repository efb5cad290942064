"""A smooth motion through positions at given times."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike
from scipy.interpolate import BSpline, make_interp_spline

from splatbot.errors import InputError
from splatbot.planning.cubics import CubicPieces
from splatbot.protocols import Array

_MAX_ERROR = 1e-9  # [rad or m] largest distance of the spline from a waypoint
_REST = [(1, 0.0), (2, 0.0)]  # velocity and acceleration at both ends


class WaypointMotion:
    """Cubic spline with continuous acceleration through positions at times, at rest at both ends.

    Velocity and acceleration are 0 at both ends. These four conditions need two knots in addition to the waypoints, in
    the middle of the first and of the last interval. Samples of a :class:`splatbot.planning.JointTrajectory` at its
    knots give that trajectory again.

    Args:
        time: (N,) increasing times from 0 [s], N >= 2.
        position: (N, J) [rad or m].

    Raises:
        InputError: a shape is wrong, a value is not finite, the times do not increase from 0, or no spline has them in
            double precision.
    """

    def __init__(self, time: ArrayLike, position: ArrayLike) -> None:
        t, q = np.asarray(time, np.float64), np.asarray(position, np.float64)
        if t.ndim != 1 or len(t) < 2 or q.ndim != 2 or len(q) != len(t):
            hint = "give times (N,) and positions (N, J), N >= 2"
            raise InputError(f"are {t.shape} and {q.shape}.", field="time, position", hint=hint)
        if not (np.isfinite(t).all() and np.isfinite(q).all()) or t[0] != 0.0 or (np.diff(t) <= 0.0).any():
            raise InputError("are not finite, or the times do not increase from 0.", field="time, position")
        knots = _knots(t)
        spline = _interpolate(t, q, knots)
        self.duration = float(t[-1])
        self._spline: BSpline = spline
        self._velocity: BSpline = spline.derivative()
        self._knots = knots

    def reference(self, t: float) -> tuple[Array, Array]:
        """Return position and velocity (J,) at a time [s]; at rest before the start and after the end."""
        inside = 0.0 < t < self.duration
        x = min(max(t, 0.0), self.duration)
        velocity = self._velocity(x) if inside else np.zeros(self._spline.c.shape[1])
        return np.asarray(self._spline(x)), np.asarray(velocity)

    def pieces(self) -> CubicPieces:
        """Return the cubic pieces."""
        acceleration = np.asarray(self._velocity.derivative()(self._knots))
        acceleration[[0, -1]] = 0.0
        curved = np.full(len(self._knots) - 1, -1, np.int64)
        return CubicPieces(self._knots, np.asarray(self._spline(self._knots)), acceleration, curved)


def _knots(t: Array) -> Array:
    """Return the N + 2 breakpoints: the waypoints and one more in the first and in the last interval."""
    if len(t) == 2:
        return np.linspace(t[0], t[1], 4)
    middle = 0.5 * (t[[0, -2]] + t[[1, -1]])
    return np.concatenate([t[:1], middle[:1], t[1:-1], middle[1:], t[-1:]])


def _interpolate(t: Array, q: Array, knots: Array) -> BSpline:
    """Return the spline; times that differ too much in their spacing give an InputError."""
    try:
        with np.errstate(all="ignore"):
            padded = np.concatenate([t[[0] * 4], knots[1:-1], t[[-1] * 4]])
            spline = make_interp_spline(t, q, k=3, t=padded, bc_type=_bc(q))
            error = float(np.abs(spline(t) - q).max())
    except (np.linalg.LinAlgError, ValueError):
        error = np.inf
    if not error <= _MAX_ERROR:
        hint = "give times of similar spacing"
        raise InputError("are too close or too far apart for a spline.", field="time", hint=hint)
    return spline


def _bc(q: Array) -> tuple[list[tuple[int, Array]], list[tuple[int, Array]]]:
    rest = [(order, np.full(q.shape[1], value)) for order, value in _REST]
    return rest, rest

"""Joint trajectories as uniform cubic B-splines in time, and their export to ROS, JSON and CSV."""

from __future__ import annotations

import csv
import io
import json
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from splatbot.errors import InputError
from splatbot.planning.cubics import CubicPieces
from splatbot.planning.problem import Certificate
from splatbot.protocols import Array, KinematicChain

# Rows: weights of four control points; columns: powers of u, 0..3.
_CUBIC = np.array([[1, -3, 3, -1], [4, 0, -6, 3], [1, 3, 3, -3], [0, 0, 0, 1]]) / 6.0


@dataclass(frozen=True, eq=False)
class JointTrajectory:
    """Uniform cubic B-spline in time, at rest at both ends.

    The differences of the control points c bound the derivatives at every time (de Boor 1978, ch. X)::

        |q'| <= max |Δc| / step,   |q''| <= max |Δ²c| / step²,   |q'''| <= max |Δ³c| / step³

    Args:
        names: names of the joints.
        control: (M, J), M >= 4, control points [rad or m].
        step: time between knots [s].
        certificate: proof for the whole curve.

    Raises:
        InputError: there are too few control points, a value is not finite, or the step is not above 0.
    """

    names: tuple[str, ...]
    control: Array
    step: float
    certificate: Certificate

    def __post_init__(self) -> None:
        if self.control.ndim != 2 or len(self.control) < 4 or self.control.shape[1] != len(self.names):
            raise InputError(f"are {self.control.shape}.", field="control", hint=f"give (M >= 4, {len(self.names)})")
        if not np.isfinite(self.control).all() or not 0.0 < self.step < np.inf:
            raise InputError("has values that are not finite.", field="trajectory", hint="give finite points and step")

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return (len(self.control) - 3) * self.step

    @property
    def start(self) -> Array:
        """First configuration (J,) [rad or m]."""
        return self.at(0.0).position

    @property
    def end(self) -> Array:
        """Last configuration (J,) [rad or m]."""
        return self.at(self.duration).position

    def at(self, t: ArrayLike) -> State:
        """Return the state at times (...) [s]; before the start and after the end the arm rests at that end."""
        times = np.asarray(t, dtype=np.float64)
        inside = (times >= 0.0) & (times <= self.duration)
        x = np.clip(times, 0.0, self.duration) / self.step
        span = np.minimum(x.astype(np.int64), len(self.control) - 4)
        u = (x - span)[..., None]
        points = self.control[span[..., None] + np.arange(4)]
        columns = []
        for order in range(4):
            powers = np.zeros((*u.shape[:-1], 4))
            for k in range(order, 4):
                factor = float(np.prod(np.arange(k - order + 1, k + 1)))
                powers[..., k] = factor * u[..., 0] ** (k - order)
            weights = powers @ _CUBIC.T
            value = np.einsum("...k,...kj->...j", weights, points) / self.step**order
            columns.append(value if order == 0 else np.where(inside[..., None], value, 0.0))
        return State(times, *columns)

    def reference(self, t: float) -> tuple[Array, Array]:
        """Return position and velocity (J,) at a time [s], as :class:`splatbot.protocols.TimedPath` requires."""
        state = self.at(t)
        return state.position, state.velocity

    def sampled(self, rate: float = 1000.0) -> State:
        """Sample the states at a rate [Hz], the end included."""
        if not 0.0 < rate < np.inf:
            raise InputError(f"is {rate}.", field="rate", hint="give hertz above 0")
        count = int(np.ceil(self.duration * rate - 1e-9))
        return self.at(np.append(np.arange(count) / rate, self.duration))

    def pieces(self) -> CubicPieces:
        """Return the cubic pieces of the curve."""
        return spline_pieces(self.control, self.step)

    def load(self, chain: KinematicChain) -> tuple[float, float, float]:
        """Return the largest fractions of the velocity, acceleration and jerk limits that the curve uses."""
        shares = []
        for order, limit in ((1, chain.velocity), (2, chain.acceleration), (3, chain.jerk)):
            largest = np.abs(np.diff(self.control, n=order, axis=0)).max(axis=0) / self.step**order
            shares.append(float((largest / limit).max()))
        return shares[0], shares[1], shares[2]

    def slowed(self, factor: float) -> JointTrajectory:
        """Return the same curve with ``factor`` times the duration; the certificate of the curve stays valid."""
        if not 0.0 < factor < np.inf:
            raise InputError(f"is {factor}.", field="factor", hint="give a number above 0, 2 for half the speed")
        return JointTrajectory(self.names, self.control, self.step * factor, self.certificate)

    def at_knots(self) -> State:
        """Return the states at the knots; :class:`splatbot.planning.WaypointMotion` turns them into the curve again."""
        return self.at(np.minimum(np.arange(len(self.control) - 2) * self.step, self.duration))

    def to_ros(self, *, rate: float | None = None, frame_id: str = "") -> dict[str, Any]:
        """Return a ``trajectory_msgs/JointTrajectory`` as a dictionary in the format of rosbridge.

        Args:
            rate: points per second [Hz]. If None, one point at each knot, from which the service executes this curve.
            frame_id: frame in the header.
        """
        states = self.at_knots() if rate is None else self.sampled(rate)
        nanoseconds = np.rint(states.time * 1e9).astype(np.int64).tolist()
        rows = (states.position.tolist(), states.velocity.tolist(), states.acceleration.tolist(), nanoseconds)
        points = [
            {
                "positions": position,
                "velocities": velocity,
                "accelerations": acceleration,
                "effort": [],
                "time_from_start": {"sec": after // 10**9, "nanosec": after % 10**9},
            }
            for position, velocity, acceleration, after in zip(*rows, strict=True)
        ]
        header = {"stamp": {"sec": 0, "nanosec": 0}, "frame_id": frame_id}
        return {"header": header, "joint_names": list(self.names), "points": points}

    def to_json(self, *, rate: float = 100.0) -> str:
        """Return :meth:`to_ros` as JSON text."""
        return json.dumps(self.to_ros(rate=rate))

    def to_csv(self, *, rate: float = 1000.0) -> str:
        """Return time, positions, velocities and accelerations as CSV text, one line per sample."""
        states = self.sampled(rate)
        text = io.StringIO()
        out = csv.writer(text, lineterminator="\n")
        kinds = ("position", "velocity", "acceleration")
        out.writerow(["time", *(f"{kind}.{name}" for kind in kinds for name in self.names)])
        for row in np.c_[states.time, states.position, states.velocity, states.acceleration]:
            out.writerow([f"{value:.9g}" for value in row])
        return text.getvalue()


@dataclass(frozen=True, eq=False)
class State:
    """State of the joints at times (...).

    Args:
        time: (...) [s].
        position: (..., J) [rad or m].
        velocity, acceleration, jerk: (..., J), position units per s, s² and s³.
    """

    time: Array
    position: Array
    velocity: Array
    acceleration: Array
    jerk: Array


def spline_pieces(control: Array, step: float = 1.0) -> CubicPieces:
    """Return the cubic pieces of a uniform cubic B-spline.

    A spline whose control points are collinear lies on their line.

    Args:
        control: (M, J) control points [rad or m].
        step: time between knots [s].
    """
    move = np.diff(control, axis=0)
    parallel = _parallel(move[:-1], move[1:])
    straight = parallel[:-1] & parallel[1:] & _parallel(move[:-2], move[2:])
    rest = (move[1:-1] == 0).all(axis=1)  # the knot between two spans is a stop if both steps that they share are 0
    joined = straight[:-1] & straight[1:] & ~(rest[:-1] & rest[1:])
    line = np.where(straight, np.cumsum(np.concatenate([[True], ~joined])), -1)
    return CubicPieces(
        time=np.arange(len(control) - 2, dtype=np.float64) * step,
        position=(control[:-2] + 4.0 * control[1:-1] + control[2:]) / 6.0,
        acceleration=np.diff(control, n=2, axis=0) / step**2,
        line=line,
    )


def _parallel(a: Array, b: Array) -> NDArray[np.bool_]:
    """Return whether vectors (N, J) have the same direction within 1e-10 of their length; a zero vector has any."""
    size_a, size_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    short, long = np.minimum(size_a, size_b), np.maximum(size_a, size_b)
    along = np.abs(a * size_b[:, None] - b * size_a[:, None]).max(axis=1)
    return np.asarray((short == 0) | (along <= 1e-10 * np.maximum(long, 1e-30)))

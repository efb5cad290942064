"""Blends: a path of straight edges with rounded corners, as a curve with two continuous derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.protocols import Array


@dataclass(frozen=True)
class BlendConstants:
    """Constants of blends between straight segments."""

    samples: int = 48
    """Number of samples [1] of a blend. More of them hold the limits of the joints between samples more closely, and
    take longer."""
    chords: int = 12
    """Number of chords [1] that approximate a blend before its speed is planned. More of them follow the curve more
    closely."""
    min_line_samples: int = 24
    """Number of samples [1] of the shortest line; longer lines have more."""


CONSTANTS = BlendConstants()


@dataclass(frozen=True, eq=False)
class Curve:
    """Curve q(s) of quintic Bezier pieces that are joined with equal first and second derivatives.

    A blend runs from ``reach`` before a corner to ``reach`` after it. Its control points lie on the two edges, three on
    each at equal distances. The blend therefore begins and ends with unit speed and zero curvature. It stays in the
    triangle of its ends and the corner. A line is a Bezier curve with evenly spaced control points.

    Args:
        control: (P, 6, J) control points of the pieces [rad or m].
        length: (P,) length of each piece in s [rad or m].
        corner: (P,) int64, index of the waypoint that a blend rounds, -1 for lines.
    """

    control: Array
    length: Array
    corner: NDArray[np.int64]

    @property
    def total(self) -> float:
        """Length in s."""
        return float(self.length.sum())

    def samples(self) -> Array:
        """Return values of s (N,), not decreasing, dense enough to plan speeds; a joint between pieces occurs twice."""
        start = np.concatenate([[0.0], np.cumsum(self.length)])
        even = max(self.total / 256, 1e-9)
        counts = np.where(
            self.corner >= 0, CONSTANTS.samples, CONSTANTS.min_line_samples + (self.length / even).astype(np.int64)
        )
        return np.concatenate([np.linspace(start[i], start[i + 1], int(counts[i])) for i in range(len(self.length))])

    def at(self, s: Array) -> tuple[Array, Array, Array]:
        """Return q, dq/ds and d²q/ds², each (N, J), at s (N,)."""
        start = np.concatenate([[0.0], np.cumsum(self.length)])
        piece = np.clip(np.searchsorted(start, s, side="right") - 1, 0, len(self.length) - 1)
        u = np.clip((s - start[piece]) / self.length[piece], 0.0, 1.0)
        b, L = self.control[piece], self.length[piece][:, None]
        velocity, bend = 5.0 * np.diff(b, axis=1), 20.0 * np.diff(b, n=2, axis=1)
        return _bezier(b, u), _bezier(velocity, u) / L, _bezier(bend, u) / L**2

    def piece_of(self, s: Array) -> NDArray[np.int64]:
        """Return the index of the piece (N,) that contains s (N,)."""
        start = np.concatenate([[0.0], np.cumsum(self.length)])
        return np.clip(np.searchsorted(start, s, side="right") - 1, 0, len(self.length) - 1)


def rounded(waypoints: Array, reach: Array, first: int) -> Curve:
    """Round the inner corners of a path.

    Args:
        waypoints: (N, J), N >= 2, from rest to rest [rad or m]; consecutive waypoints differ.
        reach: (N,) distance from each corner to both ends of its blend [rad or m]; the first and last are ignored.
        first: index of the first waypoint in the whole path, for ``Curve.corner``.
    """
    step = np.diff(waypoints, axis=0)
    edge = np.linalg.norm(step, axis=1)
    unit = step / edge[:, None]
    control, length, corner = [], [], []
    for i in range(len(edge)):
        before = reach[i] if i > 0 else 0.0
        after = reach[i + 1] if i + 1 < len(edge) else 0.0
        straight = edge[i] - before - after
        if straight > 1e-9 * edge[i]:
            start, end = waypoints[i] + before * unit[i], waypoints[i + 1] - after * unit[i]
            control.append(start + np.linspace(0.0, 1.0, 6)[:, None] * (end - start))
            length.append(straight)
            corner.append(-1)
        if after > 0.0:
            at = waypoints[i + 1]
            offsets = after * np.array([1.0, 0.6, 0.2])
            control.append(np.concatenate([at - offsets[:, None] * unit[i], at + offsets[::-1, None] * unit[i + 1]]))
            length.append(2.0 * after)
            corner.append(first + i + 1)
    return Curve(np.array(control), np.array(length), np.array(corner, dtype=np.int64))


def blend_chords(before: Array, at: Array, after: Array, reach: float) -> Array:
    """Return points (K, J) along the blend of the corner ``at`` between the waypoints ``before`` and ``after`` (J,)."""
    first, last = at - before, after - at
    curve = np.concatenate(
        [
            at - reach * np.array([1.0, 0.6, 0.2])[:, None] * first / np.linalg.norm(first),
            at + reach * np.array([0.2, 0.6, 1.0])[:, None] * last / np.linalg.norm(last),
        ]
    )
    u = np.linspace(0.0, 1.0, CONSTANTS.chords + 1)
    return _bezier(np.broadcast_to(curve, (len(u), *curve.shape)), u)


def _bezier(control: Array, u: Array) -> Array:
    """Evaluate curves with control points (N, K, J) at u (N,) by De Casteljau's algorithm; return points (N, J)."""
    points, share = control, u[:, None, None]
    while points.shape[1] > 1:
        points = points[:, :-1] * (1.0 - share) + points[:, 1:] * share
    return np.asarray(points[:, 0])

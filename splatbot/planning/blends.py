"""A path of straight edges with its corners rounded, as a curve with two continuous derivatives."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.protocols import Array

_PER_BLEND = 48  # places of a blend
_CHORDS = 12  # of a blend, where it is only looked at
_PER_LINE = 24  # at least, of a line


@dataclass(frozen=True, eq=False)
class Curve:
    """q(s) in pieces: quintic Bezier curves (a line is one too), joined with equal first and second derivatives.

    At a corner, a blend runs from ``reach`` before it to ``reach`` after it. Its control points lie on the two edges,
    the first three and the last three evenly, so that it begins and ends with unit speed and without curvature; it
    stays in the triangle of its ends and the corner.

    Args:
        control: (P, 6, J) control points of the pieces [rad or m].
        length: (P,) of each in s.
        corner: (P,) int64, the waypoint that a blend rounds; -1 for lines.
    """

    control: Array
    length: Array
    corner: NDArray[np.int64]

    @property
    def total(self) -> float:
        """Length in s."""
        return float(self.length.sum())

    def places(self) -> Array:
        """Values of s (N,), not decreasing, dense enough to plan speeds on; both sides of each joint are there."""
        start = np.concatenate([[0.0], np.cumsum(self.length)])
        even = max(self.total / 256, 1e-9)
        counts = np.where(self.corner >= 0, _PER_BLEND, _PER_LINE + (self.length / even).astype(np.int64))
        return np.concatenate([np.linspace(start[i], start[i + 1], int(counts[i])) for i in range(len(self.length))])

    def at(self, s: Array) -> tuple[Array, Array, Array]:
        """q, dq/ds and d²q/ds², each (N, J), at s (N,)."""
        start = np.concatenate([[0.0], np.cumsum(self.length)])
        piece = np.clip(np.searchsorted(start, s, side="right") - 1, 0, len(self.length) - 1)
        u = np.clip((s - start[piece]) / self.length[piece], 0.0, 1.0)
        b, L = self.control[piece], self.length[piece][:, None]
        velocity, bend = 5.0 * np.diff(b, axis=1), 20.0 * np.diff(b, n=2, axis=1)
        return _bezier(b, u), _bezier(velocity, u) / L, _bezier(bend, u) / L**2

    def piece_of(self, s: Array) -> NDArray[np.int64]:
        """The piece (N,) that s lies in."""
        start = np.concatenate([[0.0], np.cumsum(self.length)])
        return np.clip(np.searchsorted(start, s, side="right") - 1, 0, len(self.length) - 1)


def rounded(waypoints: Array, reach: Array, first: int) -> Curve:
    """The curve through waypoints (N, J), N >= 2, no two in a row alike, its inner corners rounded.

    Args:
        waypoints: of one run from rest to rest.
        reach: (N,) how far from each corner its blend begins and ends [rad or m]; those of the ends are ignored.
        first: number of the first waypoint, for ``Curve.corner``.
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
    """Places (K, J) along the blend of a corner between three waypoints (J,)."""
    first, last = at - before, after - at
    curve = np.concatenate(
        [
            at - reach * np.array([1.0, 0.6, 0.2])[:, None] * first / np.linalg.norm(first),
            at + reach * np.array([0.2, 0.6, 1.0])[:, None] * last / np.linalg.norm(last),
        ]
    )
    u = np.linspace(0.0, 1.0, _CHORDS + 1)
    return _bezier(np.broadcast_to(curve, (len(u), *curve.shape)), u)


def _bezier(control: Array, u: Array) -> Array:
    """De Casteljau: points (N, J) of curves with control points (N, K, J) at u (N,)."""
    points, share = control, u[:, None, None]
    while points.shape[1] > 1:
        points = points[:, :-1] * (1.0 - share) + points[:, 1:] * share
    return np.asarray(points[:, 0])

"""When the arm is where: a path's corners rounded, its speed as high as limits allow, the timed curve certified."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from splatbot._native import fastest_speeds
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.planning.blends import Curve, blend_chords, rounded
from splatbot.planning.problem import Certificate, Path
from splatbot.planning.trajectory import JointTrajectory
from splatbot.protocols import Array, KinematicChain

SAME = 1e-4  # [rad or m]; waypoints nearer than this are one
DEVIATION = 1e-4  # [m] that a sphere may be off the chords which stand for the curve
CLEARANCE_CUT = 0.05  # [m]; more room than this is not told apart
_SHORTEST, _LONGEST = 2e-3, 1e-2  # [s] between knots
_ROUNDS = 8  # of shortening blends
_LEAST_REACH = 4e-3  # [rad or m] of a blend; where a shorter one is needed, the arm stops at the corner
_SHARES = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)  # of the longest blend, tried at once
_FINE_EPS = 2e-5  # [m] of the certificate of short chords
_COARSE, _FINEST = 16, 1 / 64  # [spans] of the intervals that clearance is sought in


def time_path(
    path: Path,
    arm: RobotSpheres,
    field: GaussianCollisionField | None,
    *,
    velocity_scale: float = 1.0,
    acceleration_scale: float = 1.0,
) -> JointTrajectory:
    """The path as a trajectory within the arm's limits of velocity, acceleration and jerk.

    Corners are rounded as far as the arm stays free; speeds come from reachability analysis, are averaged where jerk
    asks for it, and become control points of a spline, whose differences bound all three derivatives. What is certified
    is that spline. Where no rounding is free the arm stops at the corner, in the last resort at every corner: then the
    curve is the path itself.

    Args:
        path: as planned.
        arm: that shall follow it.
        field: the map; None: free of the arm itself alone.
        velocity_scale, acceleration_scale: shares (0..1] of the limits to use; jerk is used in full.

    Returns:
        A trajectory; ``certificate.certified`` is False only if the path itself is not free.

    Raises:
        InputError: a scale is out of range, a limit is 0, or the path is of another arm.
    """
    chain = _scaled(arm.robot.chain, velocity_scale, acceleration_scale)
    if path.waypoints.ndim != 2 or path.waypoints.shape[1] != len(chain) or not np.isfinite(path.waypoints).all():
        raise InputError(f"is {path.waypoints.shape}.", field="path", hint=f"give finite (N, {len(chain)})")
    waypoints = without_duplicates(path.waypoints)
    if len(waypoints) < 2:
        rest = _Timed(np.repeat(path.waypoints[:1], 4, axis=0), _SHORTEST, np.full(4, -1))
        free = not arm.check(field, path.waypoints[:1]).in_collision.any()
        return rest.trajectory(chain, path.certificate.eps, arm, field, free)
    judge = _Judge(arm, field, path.certificate.eps)
    reach = judge.longest_blends(waypoints)
    for _ in range(_ROUNDS):
        timed = _timed(waypoints, reach, chain)
        failed = judge.not_free(timed.control)
        if not failed.any():
            return timed.trajectory(chain, path.certificate.eps, arm, field, True)
        if not _shorten(reach, timed, failed):
            break
    timed = _timed(waypoints, np.zeros(len(waypoints)), chain)  # every point of it is on the path
    free = not arm.certify(field, waypoints[:-1], waypoints[1:], eps=path.certificate.eps).in_collision.any()
    return timed.trajectory(chain, path.certificate.eps, arm, field, free)


def without_duplicates(waypoints: Array) -> Array:
    """The waypoints (N, J) without those that are as good as the one before; the ends stay what they are."""
    kept = [waypoints[0]]
    for q in waypoints[1:]:
        if np.abs(q - kept[-1]).max() > SAME:
            kept.append(q)
    if len(kept) > 1:
        kept[-1] = waypoints[-1]
    return np.array(kept)


@dataclass(frozen=True, eq=False)
class _Timed:
    """Control points (M, J) of a spline of knots ``step`` [s] apart, and the corner (M,) that each rounds, -1 none."""

    control: Array
    step: float
    corner: NDArray[np.int64]

    def trajectory(
        self, chain: KinematicChain, eps: float, arm: RobotSpheres, field: GaussianCollisionField | None, free: bool
    ) -> JointTrajectory:
        """With its certificate, and slowed down by what is left above a limit."""
        nothing = Certificate(False, eps, 0.0, arm.margin, -1)
        found = JointTrajectory(chain.names, self.control, self.step, nothing)
        v, a, j = found.load(chain)
        over = max(v, np.sqrt(a), np.cbrt(j), 1.0)
        step = self.step * float(over) * (1.0 + 1e-9)
        return JointTrajectory(chain.names, self.control, step, _certificate(eps, arm, field, found, free))


def _timed(waypoints: Array, reach: Array, chain: KinematicChain) -> _Timed:
    """From rest to rest between the corners without a blend."""
    stops = [0, *(i for i in range(1, len(waypoints) - 1) if reach[i] == 0.0), len(waypoints) - 1]
    smooth = float((2.0 * chain.acceleration / chain.jerk).max())  # [s] over which accelerations are averaged
    step = float(np.clip(smooth, _SHORTEST, _LONGEST))
    wide = int(np.ceil(smooth / step - 1e-9))
    control: list[Array] = []
    corner: list[NDArray[np.int64]] = []
    for a, b in pairwise(stops):
        curve = rounded(waypoints[a : b + 1], reach[a : b + 1], a)
        q, rounds = _sampled(curve, chain, step)
        pad = wide + 1  # three alike at either end: at rest, without acceleration
        q = np.concatenate([np.repeat(q[:1], pad, axis=0), q, np.repeat(q[-1:], pad, axis=0)])
        rounds = np.concatenate([np.full(pad, -1), rounds, np.full(pad, -1)])
        sums = np.cumsum(np.concatenate([np.zeros((1, q.shape[1])), q - q[0]]), axis=0)
        even = q[0] + (sums[wide:] - sums[:-wide]) / wide
        even[:3], even[-3:] = waypoints[a], waypoints[b]
        keep = slice(3 if control else 0, None)  # a stop is one place
        control.append(even[keep])
        corner.append(rounds[wide // 2 :][: len(even)][keep])
    return _Timed(np.concatenate(control), step, np.concatenate(corner))


def _sampled(curve: Curve, chain: KinematicChain, step: float) -> tuple[Array, NDArray[np.int64]]:
    """Configurations (K, J) every ``step`` [s] of the fastest motion along a curve, and the corners (K,) they round."""
    s = curve.places()
    _, first, second = curve.at(s)
    # Just within, for what happens between two places.
    squared = fastest_speeds(
        s, np.ascontiguousarray(first), np.ascontiguousarray(second), 0.999 * chain.velocity, 0.99 * chain.acceleration
    )
    speed = np.sqrt(squared)
    spent = np.where(np.diff(s) > 0, 2.0 * np.diff(s) / np.maximum(speed[:-1] + speed[1:], 1e-12), 0.0)
    time = np.concatenate([[0.0], np.cumsum(spent)])
    t = np.append(np.arange(0.0, time[-1], step), time[-1])
    i = np.clip(np.searchsorted(time, t, side="right") - 1, 0, len(spent) - 1)
    passed = t - time[i]
    gain = np.where(spent > 0, (speed[1:] - speed[:-1]) / np.maximum(spent, 1e-12), 0.0)[i]
    at = np.clip(s[i] + speed[i] * passed + 0.5 * gain * passed**2, s[i], s[i + 1])
    return curve.at(at)[0], curve.corner[curve.piece_of(at)]


def _shorten(reach: Array, timed: _Timed, failed: NDArray[np.bool_]) -> bool:
    """Half of each blend that a span (M - 3,) which is not free belongs to; False if one belongs to none."""
    blame = set()
    for span in np.flatnonzero(failed):
        near = timed.corner[span : span + 4]
        corners = near[near >= 0]
        if not len(corners):
            return False
        blame.add(int(corners[0]))
    for corner in blame:
        reach[corner] = 0.5 * reach[corner] if reach[corner] > 2.0 * _LEAST_REACH else 0.0
    return True


class _Judge:
    """Whether curves of an arm are free."""

    def __init__(self, arm: RobotSpheres, field: GaussianCollisionField | None, eps: float) -> None:
        self.arm, self.field = arm, field
        self.grown = arm.grown(DEVIATION)
        self.eps = max(_FINE_EPS, min(eps, DEVIATION))

    def longest_blends(self, waypoints: Array) -> Array:
        """How far from each waypoint (N,) its blend may reach, as far as chords tell; 0 at the ends."""
        edge = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
        reach = np.zeros(len(waypoints))
        inner = range(1, len(waypoints) - 1)
        tried = [(i, share * 0.49 * min(edge[i - 1], edge[i])) for i in inner for share in _SHARES]
        tried = [(i, r) for i, r in tried if r >= _LEAST_REACH]
        if not tried:
            return reach
        chords = np.array([blend_chords(waypoints[i - 1], waypoints[i], waypoints[i + 1], r) for i, r in tried])
        joints = waypoints.shape[1]
        starts, ends = chords[:, :-1].reshape(-1, joints), chords[:, 1:].reshape(-1, joints)
        hit = self.grown.certify(self.field, starts, ends, eps=self.eps).in_collision.reshape(len(tried), -1)
        for (i, r), blocked in zip(tried, hit, strict=True):
            if not blocked.any():
                reach[i] = max(reach[i], r)
        return reach

    def not_free(self, control: Array) -> NDArray[np.bool_]:
        """Which spans (M - 3,) of a spline are not known to be free."""
        start, end, first, last = chords(control, self.arm.reach)
        hit = self.grown.certify(self.field, start, end, eps=self.eps).in_collision
        failed = np.zeros(len(control) - 3, np.bool_)
        for a, b in zip(first[hit], last[hit], strict=True):
            failed[a : b + 1] = True
        return failed


def chords(control: Array, reach: Array) -> tuple[Array, Array, NDArray[np.int64], NDArray[np.int64]]:
    """Straight edges that no sphere is farther from than ``DEVIATION`` on a spline: starts, ends (K, J), and the spans
    (K,) that each begins and ends in.

    Where control points lie on one line, the curve is on it. Elsewhere the second derivative between two knots is
    between those at its ends, so that a chord over a share h of a span is off by at most h²/8 of the larger.

    Args:
        control: (M, J).
        reach: (S, J), see :attr:`splatbot.collision.RobotSpheres.reach`.
    """
    step = np.diff(control, axis=0)
    straight = _parallel(step[:-1], step[1:])
    straight = straight[:-1] & straight[1:] & _parallel(step[:-2], step[2:])
    rest = (step[1:-1] == 0).all(axis=1)  # the place between two spans is a stop if the two steps they share are none
    joined = straight[:-1] & straight[1:] & ~(rest[:-1] & rest[1:])
    bend = np.abs(np.diff(control, n=2, axis=0))
    moves = (np.maximum(bend[:-1], bend[1:]) / 8.0 @ reach.T).max(axis=1)
    parts = np.where(straight, 1, np.maximum(1, np.ceil(np.sqrt(moves / DEVIATION)))).astype(np.int64)
    span = np.repeat(np.arange(len(parts)), parts)
    u = (np.arange(len(span)) - np.repeat(np.cumsum(parts) - parts, parts)) / parts[span]
    c = control[span[:, None] + np.arange(4)]
    weights = np.stack([(1 - u) ** 3, 3 * u**3 - 6 * u**2 + 4, -3 * u**3 + 3 * u**2 + 3 * u + 1, u**3], axis=1) / 6.0
    places = np.concatenate(
        [np.einsum("nk,nkj->nj", weights, c), (control[-3] + 4.0 * control[-2] + control[-1])[None] / 6.0]
    )
    begins = np.concatenate([[True], ~((np.diff(span) == 1) & joined[np.minimum(span[:-1], len(joined) - 1)])])
    first = np.flatnonzero(begins)
    after = np.append(first[1:], len(span))
    return places[first], places[after], span[first], span[after - 1]


def _parallel(a: Array, b: Array) -> NDArray[np.bool_]:
    """Whether vectors (N, J) have one direction, to a nanometre or so; none has any."""
    size_a, size_b = np.linalg.norm(a, axis=1), np.linalg.norm(b, axis=1)
    short, long = np.minimum(size_a, size_b), np.maximum(size_a, size_b)
    along = np.abs(a * size_b[:, None] - b * size_a[:, None]).max(axis=1)
    return np.asarray((short == 0) | (along <= 1e-10 * np.maximum(long, 1e-30)))


def _certificate(
    eps: float, arm: RobotSpheres, field: GaussianCollisionField | None, trajectory: JointTrajectory, free: bool
) -> Certificate:
    if field is None:
        return Certificate(free, eps, 0.0, arm.margin, -1)
    room = least_room(arm, field, trajectory.control) if free else 0.0
    return Certificate(free, eps, max(0.0, room), arm.margin, field.map_version)


def least_room(arm: RobotSpheres, field: GaussianCollisionField, control: Array) -> float:
    """A lower bound of the arm's clearance all along a spline [m], at most ``CLEARANCE_CUT``; to 2 % and 0.1 mm.

    On an interval, the room is at least that in its middle less what a sphere moves in half of it; intervals that may
    hold the least are halved.
    """
    from_knot = np.abs(np.diff(control, axis=0)) @ arm.reach.T  # (M - 1, S): a sphere's way between two knots, at most
    most = np.maximum(np.maximum(from_knot[:-2], from_knot[1:-1]), from_knot[2:])  # (M - 3, S) by span
    way = np.concatenate([[0.0], np.cumsum(most.max(axis=1))])  # of the fastest sphere, up to each knot
    spans = len(control) - 3
    middle, half = np.arange(0, spans, _COARSE) + _COARSE / 2, np.full(-(-spans // _COARSE), _COARSE / 2)
    spline = JointTrajectory(arm.robot.chain.names, control, 1.0, Certificate(False, 0.0, 0.0, 0.0, -1))
    low, best = np.inf, CLEARANCE_CUT
    while len(middle):
        at = np.interp(np.stack([middle - half, middle, middle + half]), np.arange(spans + 1), way)
        moves = np.maximum(at[2] - at[1], at[1] - at[0])
        cut = CLEARANCE_CUT + float(moves.max())  # so far that what is beyond needs no halving
        room = np.minimum(arm.native.clearance(field.native, spline.at(middle).position, cut)[0], cut)
        best = min(best, float(room.min()))
        bound = np.minimum(room - moves, CLEARANCE_CUT)
        open_ = bound < 0.98 * best - 1e-4
        low = min(low, float(bound[~open_].min()) if (~open_).any() else np.inf)
        if half[0] < _FINEST:
            low = min(low, float(bound.min()))
            break
        middle, half = middle[open_], half[open_] / 2
        middle, half = np.concatenate([middle - half, middle + half]), np.tile(half, 2)
    return min(low, CLEARANCE_CUT)


def _scaled(chain: KinematicChain, velocity: float, acceleration: float) -> KinematicChain:
    for name, scale in (("velocity_scale", velocity), ("acceleration_scale", acceleration)):
        if not 0.0 < scale <= 1.0:
            raise InputError(f"is {scale}.", field=name, hint="give a share above 0, at most 1")
    if min(chain.velocity.min(), chain.acceleration.min(), chain.jerk.min()) <= 0.0:
        raise InputError("has a limit of 0.", field="chain", hint="give velocity, acceleration and jerk above 0")
    return KinematicChain(
        chain.names,
        chain.T_before_joint,
        chain.prismatic,
        chain.lower,
        chain.upper,
        velocity * chain.velocity,
        acceleration * chain.acceleration,
        chain.jerk,
        chain.effort,
    )

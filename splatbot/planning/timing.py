"""Time parametrization of a path: rounded corners, the highest speed within the limits, a certified spline."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from splatbot._native import fastest_speeds
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.planning.blends import Curve, blend_chords, rounded
from splatbot.planning.cubics import DEVIATION
from splatbot.planning.problem import Certificate, Path
from splatbot.planning.trajectory import JointTrajectory, spline_pieces
from splatbot.protocols import Array, KinematicChain


@dataclass(frozen=True)
class TimingConstants:
    """Constants of timed trajectories and of their certificates.

    Args:
        min_waypoint_step: [rad or m] waypoints that differ by less in every joint count as one.
        clearance_cut: [m] largest clearance of the certificate of a trajectory.
        min_knot_step: [s] shortest time between knots.
        max_knot_step: [s] longest time between knots.
        limit_reserve: factor of the duration that keeps the limits although messages round times to nanoseconds.
        max_shortenings: largest number of times that colliding blends are shortened.
        min_reach: [rad or m] smallest reach of a blend; at a corner that needs a smaller one the arm stops.
        reach_fractions: candidates for the reach, as fractions of the largest.
        min_chord_eps: [m] smallest eps of the certificate of short chords.
        max_interval: [spans] longest interval of the search for the smallest clearance.
        min_interval: [spans] shortest interval of that search.
        max_duration: [s] longest motion between two stops.
    """

    min_waypoint_step: float = 1e-4
    clearance_cut: float = 0.05
    min_knot_step: float = 2e-3
    max_knot_step: float = 1e-2
    limit_reserve: float = 1.0005
    max_shortenings: int = 8
    min_reach: float = 4e-3
    reach_fractions: tuple[float, ...] = (1.0, 0.5, 0.25, 0.12, 0.06, 0.03)
    min_chord_eps: float = 2e-5
    max_interval: int = 16
    min_interval: float = 1 / 64
    max_duration: float = 300.0


CONSTANTS = TimingConstants()
_BLOCK = 4096  # samples of a curve at a time

DEFAULT_SPEED = 0.2
"""Fraction of the limits of velocity and acceleration at which commands and services move an arm."""


def time_path(
    path: Path,
    arm: RobotSpheres,
    field: GaussianCollisionField | None,
    *,
    velocity_scale: float = 1.0,
    acceleration_scale: float = 1.0,
) -> JointTrajectory:
    """Turn a path into a trajectory within the velocity, acceleration and jerk limits of the arm.

    1. Blends round the corners as far as the arm stays free of collisions.
    2. Reachability analysis computes the fastest speeds (TOPP-RA: Pham and Pham, T-RO 2018).
    3. A moving average over ``2 a_max / j_max`` limits the jerk. Its samples are the control points of a cubic
       B-spline, whose differences bound all three derivatives.
    4. The spline is certified. A blend that collides is shortened. Below a minimum length the arm stops at the corner.

    If this fails, the arm stops at every corner; the curve is then the path itself.

    Args:
        path: planned path.
        arm: the robot.
        field: collision field. If None, only self-collision is checked.
        velocity_scale, acceleration_scale: fractions (0..1] of the limits; the jerk limit is used in full.

    Returns:
        A trajectory. ``certificate.certified`` is False only if the path itself collides.

    Raises:
        InputError: a scale is out of range or makes the motion last more than 300 s, a limit is 0, or the path has
            another number of joints.
    """
    chain = _scaled(arm.robot.chain, velocity_scale, acceleration_scale)
    if path.waypoints.ndim != 2 or path.waypoints.shape[1] != len(chain) or not np.isfinite(path.waypoints).all():
        raise InputError(f"is {path.waypoints.shape}.", field="path", hint=f"give finite (N, {len(chain)})")
    waypoints = without_duplicates(path.waypoints)
    if len(waypoints) < 2:
        rest = _TimedSpline(np.repeat(path.waypoints[:1], 4, axis=0), CONSTANTS.min_knot_step, np.full(4, -1))
        free = not arm.check(field, path.waypoints[:1]).in_collision.any()
        return rest.trajectory(chain, path.certificate.eps, arm, field, free)
    checker = _CurveChecker(arm, field, path.certificate.eps)
    reach = checker.max_reach(waypoints)
    for _ in range(CONSTANTS.max_shortenings):
        timed = _timed(waypoints, reach, chain)
        failed = checker.colliding_spans(timed.control)
        if not failed.any():
            return timed.trajectory(chain, path.certificate.eps, arm, field, True)
        if not _shorten(reach, timed, failed):
            break
    timed = _timed(waypoints, np.zeros(len(waypoints)), chain)  # every point of this curve is on the path
    free = not arm.certify(field, waypoints[:-1], waypoints[1:], eps=path.certificate.eps).in_collision.any()
    return timed.trajectory(chain, path.certificate.eps, arm, field, free)


def without_duplicates(waypoints: Array) -> Array:
    """Remove waypoints (N, J) that nearly equal their predecessor; both ends are kept."""
    kept = [waypoints[0]]
    for q in waypoints[1:]:
        if np.abs(q - kept[-1]).max() > CONSTANTS.min_waypoint_step:
            kept.append(q)
    if len(kept) > 1:
        kept[-1] = waypoints[-1]
    return np.array(kept)


@dataclass(frozen=True, eq=False)
class _TimedSpline:
    """Control points (M, J) of a spline with knots ``step`` [s] apart, and the corner (M,) that each rounds, or -1."""

    control: Array
    step: float
    corner: NDArray[np.int64]

    def trajectory(
        self, chain: KinematicChain, eps: float, arm: RobotSpheres, field: GaussianCollisionField | None, free: bool
    ) -> JointTrajectory:
        """Return the trajectory with its certificate, slowed down where a derivative still exceeds its limit."""
        uncertified = Certificate(False, eps, 0.0, arm.margin, -1)
        spline = JointTrajectory(chain.names, self.control, self.step, uncertified)
        v, a, j = spline.load(chain)
        slowdown = max(CONSTANTS.limit_reserve * max(v, np.sqrt(a), np.cbrt(j)), 1.0)
        step = self.step * float(slowdown)
        return JointTrajectory(chain.names, self.control, step, _certificate(eps, arm, field, spline, free))


def _timed(waypoints: Array, reach: Array, chain: KinematicChain) -> _TimedSpline:
    """Time the path; the arm comes to rest at corners without a blend."""
    stops = [0, *(i for i in range(1, len(waypoints) - 1) if reach[i] == 0.0), len(waypoints) - 1]
    smooth = float((2.0 * chain.acceleration / chain.jerk).max())  # [s] window of the moving average
    step = float(np.clip(smooth, CONSTANTS.min_knot_step, CONSTANTS.max_knot_step))
    wide = int(np.ceil(smooth / step - 1e-9))
    control: list[Array] = []
    corner: list[NDArray[np.int64]] = []
    for a, b in pairwise(stops):
        curve = rounded(waypoints[a : b + 1], reach[a : b + 1], a)
        q, rounds = _sampled(curve, chain, step)
        pad = wide + 1  # three equal control points at each end: velocity and acceleration are 0
        q = np.concatenate([np.repeat(q[:1], pad, axis=0), q, np.repeat(q[-1:], pad, axis=0)])
        rounds = np.concatenate([np.full(pad, -1), rounds, np.full(pad, -1)])
        sums = np.cumsum(np.concatenate([np.zeros((1, q.shape[1])), q - q[0]]), axis=0)
        averaged = q[0] + (sums[wide:] - sums[:-wide]) / wide
        averaged[:3], averaged[-3:] = waypoints[a], waypoints[b]
        keep = slice(3 if control else 0, None)  # adjacent pieces share the control points of a stop
        control.append(averaged[keep])
        corner.append(rounds[wide // 2 :][: len(averaged)][keep])
    return _TimedSpline(np.concatenate(control), step, np.concatenate(corner))


def _sampled(curve: Curve, chain: KinematicChain, step: float) -> tuple[Array, NDArray[np.int64]]:
    """Sample the fastest motion along a curve every ``step`` [s].

    Returns:
        Configurations (K, J) and the corners (K,) that they round, -1 on lines.
    """
    s = curve.samples()
    _, first, second = curve.at(s)
    # Speeds are planned slightly within the limits, because velocities between two samples may be larger.
    squared = fastest_speeds(
        s, np.ascontiguousarray(first), np.ascontiguousarray(second), 0.999 * chain.velocity, 0.99 * chain.acceleration
    )
    speed = np.sqrt(squared)
    duration = np.where(np.diff(s) > 0, 2.0 * np.diff(s) / np.maximum(speed[:-1] + speed[1:], 1e-12), 0.0)
    time = np.concatenate([[0.0], np.cumsum(duration)])
    if not time[-1] <= CONSTANTS.max_duration:
        raise InputError(
            f"makes the motion last {time[-1]:.3g} s.",
            field="velocity_scale",
            hint=f"move faster: a motion lasts at most {CONSTANTS.max_duration:g} s",
        )
    t = np.append(np.arange(0.0, time[-1], step), time[-1])
    i = np.clip(np.searchsorted(time, t, side="right") - 1, 0, len(duration) - 1)
    elapsed = t - time[i]
    gain = np.where(duration > 0, (speed[1:] - speed[:-1]) / np.maximum(duration, 1e-12), 0.0)[i]
    at = np.clip(s[i] + speed[i] * elapsed + 0.5 * gain * elapsed**2, s[i], s[i + 1])
    parts = np.array_split(at, -(-len(at) // _BLOCK))  # the derivatives of a long motion take 150 MB at once
    return np.concatenate([curve.at(part)[0] for part in parts]), curve.corner[curve.piece_of(at)]


def _shorten(reach: Array, timed: _TimedSpline, failed: NDArray[np.bool_]) -> bool:
    """Halve the reach of each blend with a colliding span (M - 3,); return False if a span belongs to no blend."""
    colliding = set()
    for span in np.flatnonzero(failed):
        near = timed.corner[span : span + 4]
        corners = near[near >= 0]
        if not len(corners):
            return False
        colliding.add(int(corners[0]))
    for corner in colliding:
        reach[corner] = 0.5 * reach[corner] if reach[corner] > 2.0 * CONSTANTS.min_reach else 0.0
    return True


class _CurveChecker:
    """Collision checks of curves of an arm."""

    def __init__(self, arm: RobotSpheres, field: GaussianCollisionField | None, eps: float) -> None:
        self.arm, self.field = arm, field
        self.grown = arm.grown(DEVIATION)
        self.eps = max(CONSTANTS.min_chord_eps, min(eps, DEVIATION))

    def max_reach(self, waypoints: Array) -> Array:
        """Return the largest reach (N,) of a blend at each waypoint whose chords are free; 0 at both ends."""
        edge = np.linalg.norm(np.diff(waypoints, axis=0), axis=1)
        reach = np.zeros(len(waypoints))
        inner = range(1, len(waypoints) - 1)
        tried = [(i, share * 0.49 * min(edge[i - 1], edge[i])) for i in inner for share in CONSTANTS.reach_fractions]
        tried = [(i, r) for i, r in tried if r >= CONSTANTS.min_reach]
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

    def colliding_spans(self, control: Array) -> NDArray[np.bool_]:
        """Return for each span (M - 3,) of a spline whether it is not certified as free."""
        chords = spline_pieces(control).chords(self.arm.reach)
        hit = self.grown.certify(self.field, chords.start, chords.end, eps=self.eps).in_collision
        failed = np.zeros(len(control) - 3, np.bool_)
        for a, b in zip(chords.first[hit], chords.last[hit], strict=True):
            failed[a : b + 1] = True
        return failed


def _certificate(
    eps: float, arm: RobotSpheres, field: GaussianCollisionField | None, trajectory: JointTrajectory, free: bool
) -> Certificate:
    if field is None:
        return Certificate(free, eps, 0.0, arm.margin, -1)
    clearance = min_clearance(arm, field, trajectory.control) if free else 0.0
    return Certificate(free, eps, max(0.0, clearance), arm.margin, field.map_version)


def clearance_text(certificate: Certificate) -> str:
    """Describe the clearance of a trajectory's certificate, which is not computed beyond a cut."""
    least, margin = f"{1e3 * certificate.clearance:.1f} mm", f"beyond a margin of {1e3 * certificate.margin:.1f} mm"
    if certificate.clearance >= CONSTANTS.clearance_cut * (1 - 1e-9):
        return f"at least {least} {margin} along the whole curve (the certificate looks no farther)"
    return f"at least {least} {margin} along the whole curve"


def min_clearance(arm: RobotSpheres, field: GaussianCollisionField, control: Array) -> float:
    """Return a lower bound of the arm's clearance along a spline [m], at most ``clearance_cut``.

    The clearance on an interval is at least that at its midpoint less the largest motion of a sphere from there. The
    search bisects the intervals whose bound is the smallest, until the bound is tight to 2 % and 0.1 mm.
    """
    from_knot = (np.abs(np.diff(control, axis=0)) @ arm.reach.T).max(axis=1)  # (M - 1,) bound on motion between knots
    largest = np.maximum(np.maximum(from_knot[:-2], from_knot[1:-1]), from_knot[2:])  # (M - 3,) by span
    path_length = np.concatenate([[0.0], np.cumsum(largest)])  # of the fastest sphere, up to each knot
    spans = len(control) - 3
    middle, half = (
        np.arange(0, spans, CONSTANTS.max_interval) + CONSTANTS.max_interval / 2,
        np.full(-(-spans // CONSTANTS.max_interval), CONSTANTS.max_interval / 2),
    )
    spline = JointTrajectory(arm.robot.chain.names, control, 1.0, Certificate(False, 0.0, 0.0, 0.0, -1))
    low, best = np.inf, CONSTANTS.clearance_cut
    while len(middle):
        at = np.interp(np.stack([middle - half, middle, middle + half]), np.arange(spans + 1), path_length)
        moves = np.maximum(at[2] - at[1], at[1] - at[0])
        cut = CONSTANTS.clearance_cut + float(
            moves.max()
        )  # an interval with this clearance at its midpoint needs no bisection
        clearance = np.minimum(arm.native.clearance(field.native, spline.at(middle).position, cut)[0], cut)
        best = min(best, float(clearance.min()))
        bound = np.minimum(clearance - moves, CONSTANTS.clearance_cut)
        open_ = bound < 0.98 * best - 1e-4
        low = min(low, float(bound[~open_].min()) if (~open_).any() else np.inf)
        if half[0] < CONSTANTS.min_interval:
            low = min(low, float(bound.min()))
            break
        middle, half = middle[open_], half[open_] / 2
        middle, half = np.concatenate([middle - half, middle + half]), np.tile(half, 2)
    return min(low, CONSTANTS.clearance_cut)


def _scaled(chain: KinematicChain, velocity: float, acceleration: float) -> KinematicChain:
    for name, scale in (("velocity_scale", velocity), ("acceleration_scale", acceleration)):
        if not 0.0 < scale <= 1.0:
            raise InputError(f"is {scale}.", field=name, hint="give a fraction above 0, at most 1")
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

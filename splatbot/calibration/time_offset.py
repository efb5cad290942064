"""Time offset between two recordings of one rigid motion."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.signal import correlate, correlation_lags
from scipy.spatial.transform import Rotation, Slerp

from splatbot.errors import InputError

Array = NDArray[np.float64]

_STEP = 0.005  # [s] of the grid on which speeds are compared; the peak is interpolated between its points
_WINDOWS = (0.1, 0.3, 1.0)  # [s] over which a speed is the mean, at least two samples. The first finds the offset.
_NEAR = 0.25  # [s] from the first offset, within which those of longer windows are: longer ones repeat more easily
_MIN_OVERLAP = 0.5  # [1] of the shorter recording
_MAX_SAMPLES = 2_000_000  # of a recording on the grid: 2.8 hours
_LEAST_VARIANCE = 0.1  # [1] of the variance of all speeds that those of an overlap need
_APART, _AMBIGUOUS = 1.0, 0.03  # [s] and [1]: another peak so far away, and lower by so little, leaves a doubt
_LEAST_CORRELATION = 0.6  # [1] of a peak that can be trusted as a start


def cross_correlate(stamps_a: Array, T_a: Array, stamps_b: Array, T_b: Array) -> float:
    """Compute the delay [s] with which angular speeds agree best: |ω_b(t)| = |ω_a(t + delay)|.

    Angular speeds of two frames on one rigid body are equal for any poses of these frames. The normalized
    cross-correlation of both speeds has its peak at the delay; a parabola through its top interpolates it. Noise of the
    poses lowers the peak at short windows, and quick motion at long ones: the window with the highest peak counts.

    Args:
        stamps_a, stamps_b: (N,), (M,) increasing times [s], possibly of clocks with different zeros.
        T_a, T_b: (N, 4, 4), (M, 4, 4) poses of the two frames.

    Raises:
        InputError: a recording is too short or too long, or the speeds agree nowhere or at several delays.
    """
    least = max(2.0 * float(np.median(np.diff(stamps))) for stamps in (stamps_a, stamps_b))
    delays, score = _correlation(stamps_a, T_a, stamps_b, T_b, max(_WINDOWS[0], least))
    _check_peak(score)
    first, peaks = _peak(delays, score), []
    for window in _WINDOWS[1:]:
        delays, score = _correlation(stamps_a, T_a, stamps_b, T_b, max(window, least))
        near = np.abs(delays - first.delay) <= _NEAR
        peaks.append(_peak(delays, np.where(near, score, -1.0)))
    return max(first, *peaks, key=lambda peak: peak.score).delay


class _Peak(NamedTuple):
    delay: float  # [s]
    score: float  # [1] normalized correlation


def _peak(delays: Array, score: Array) -> _Peak:
    """Return the highest peak of a correlation, interpolated between its points."""
    best, shift = int(np.argmax(score)), 0.0
    if 0 < best < len(score) - 1 and min(score[best - 1], score[best + 1]) > -1.0:
        left, top, right = score[best - 1 : best + 2]
        shift = 0.5 * (left - right) / min(left - 2 * top + right, -1e-300)
    return _Peak(float(delays[best] + _STEP * shift), float(score[best]))


def _correlation(stamps_a: Array, T_a: Array, stamps_b: Array, T_b: Array, window: float) -> tuple[Array, Array]:
    """Return delays [s] and the correlations [1] of the speeds over ``window`` [s]; -1 where too little overlaps."""
    starts, speeds = zip(*(_angular_speed(t, T, window) for t, T in ((stamps_a, T_a), (stamps_b, T_b))), strict=True)
    a, b = (speed - speed.mean() for speed in speeds)
    ones = np.ones(len(a)), np.ones(len(b))
    overlap = np.maximum(np.rint(correlate(*ones)), 1.0)
    mean_a, mean_b = correlate(a, ones[1]) / overlap, correlate(ones[0], b) / overlap
    var_a = correlate(a**2, ones[1]) / overlap - mean_a**2
    var_b = correlate(ones[0], b**2) / overlap - mean_b**2
    moves = (var_a > _LEAST_VARIANCE * a.var()) & (var_b > _LEAST_VARIANCE * b.var())  # not two arms at rest
    enough = moves & (overlap >= _MIN_OVERLAP * min(len(a), len(b)))
    scale = np.sqrt(np.where(enough, var_a * var_b, 1.0))
    score = np.where(
        enough & (scale > 0), (correlate(a, b) / overlap - mean_a * mean_b) / np.maximum(scale, 1e-300), -1.0
    )
    return starts[0] - starts[1] + _STEP * correlation_lags(len(a), len(b)), score


def _check_peak(score: Array) -> None:
    """Check that a correlation has one peak that is high enough."""
    best = int(np.argmax(score))
    if not score[best] > _LEAST_CORRELATION:
        raise InputError(
            f"do not agree: their angular speeds correlate by {score[best]:.2f} at most.",
            field="recordings",
            hint="give two recordings of one motion that turns, both at 5 Hz or more, or --same-clock",
        )
    peaks = np.flatnonzero((score[1:-1] >= score[:-2]) & (score[1:-1] > score[2:])) + 1
    others = peaks[np.abs(peaks - best) * _STEP > _APART]
    if len(others) and score[others].max() > score[best] - _AMBIGUOUS:
        other = int(others[score[others].argmax()])
        raise InputError(
            f"agree at two time offsets, {_STEP * abs(other - best):.2f} s apart: the motion repeats.",
            field="recordings",
            hint="give a part that does not repeat, or --same-clock if both have one clock",
        )


def _angular_speed(stamps: Array, T: Array, window: float) -> tuple[float, Array]:
    """Return the first time [s] and the mean angular speeds [rad/s] over ``window`` [s] on a grid."""
    if len(stamps) < 20:
        raise InputError(f"has {len(stamps)} poses.", field="recordings", hint="give 20 poses or more")
    duration = float(stamps[-1] - stamps[0])
    if duration > _STEP * _MAX_SAMPLES:
        raise InputError(f"lasts {duration:.0f} s.", field="recordings", hint="give a part of it; a minute is enough")
    times = np.arange(stamps[0] + 0.5 * window, stamps[-1] - 0.5 * window, _STEP)
    turns = Slerp(stamps, Rotation.from_matrix(T[:, :3, :3]))
    before, after = (turns(np.clip(times + k * window, stamps[0], stamps[-1])) for k in (-0.5, 0.5))
    speed = (before.inv() * after).magnitude() / window
    return float(times[0]), np.asarray(speed)

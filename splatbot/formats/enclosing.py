"""Ellipsoids as few integers, such that each decoded ellipsoid contains the given one.

The axes of an ellipsoid are sorted from long to thin. Its rotation is the quaternion (1, -Y, X, 0) (1, 0, 0, T), which
turns about the thin axis by T and then turns this axis by X and Y. All three are in -1..1, because an ellipsoid is the
same after half a turn about an axis. A turn of a nearly round ellipsoid changes it little, so the ratios of the scales
give the bits of X, Y and T. The mean is an offset along the axes, in steps of a share of the scales.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from splatbot.geometry import quat_multiply, quat_to_rotation

Array = NDArray[np.float64]
Ints = NDArray[np.int64]
Table = NDArray[np.float32]

SCALE_FLOOR = 5e-5  # [m]; that of splatbot.collision, which formats do not import
MAX_VALUE = 1e6  # [m] largest mean and scale of a collision field
SLACK = 2.0**-10  # share of the semi-axes that is left for the float32 rounding of a field

SCALE_STEPS = 12  # of an octave
OFFSET_STEPS = np.array([0.08, 0.08, 0.16])  # of a scale, from long to thin
TILT_STEPS, TWIST_STEPS = 12.0, 16.0  # of X and Y, and of T, times r - 1 / r for a ratio r of scales
MAX_TURN_BITS = 22

MIN_CODE = int(np.floor(SCALE_STEPS * np.log2(SCALE_FLOOR)))
MAX_CODE = int(np.ceil(SCALE_STEPS * np.log2(4.0 * MAX_VALUE)))  # MAX_VALUE, and room to grow

_ROUNDS = 12  # in which single axes grow; later all grow
_P_SHARE = 0.8  # of the length of b, see _reach


class Solids(NamedTuple):
    """Ellipsoids of one standard deviation.

    Args:
        means: (N, 3) [m].
        axes: (N, 3, 3), columns from the long to the thin axis.
        scales: (N, 3) semi-axes [m], from long to thin.
    """

    means: Array
    axes: Array
    scales: Array


class Shapes(NamedTuple):
    """Integers of ellipsoids.

    Args:
        scales: (N, 3), from long to thin; a scale is ``2 ** (code / SCALE_STEPS)`` m.
        turns: (N, 3), the interval of -1..1 in which X, Y and T are, of ``2 **`` :func:`turn_bits` intervals.
        offsets: (N, 3) of the mean from a given centre, along the axes, in steps of ``OFFSET_STEPS`` of the scales.
    """

    scales: Ints
    turns: Ints
    offsets: Ints


def enclose(solids: Solids, centres: Array) -> Shapes:
    """Return integers whose ellipsoids contain the given ones at each number of standard deviations of 1 or more.

    The scales are rounded up. Then those along which an ellipsoid reaches out of its decoded one grow, step by step,
    until it is inside.

    Args:
        solids: scales of ``SCALE_FLOOR`` to ``MAX_VALUE``.
        centres: (N, 3) [m], known to the decoder.
    """
    codes = np.ceil(SCALE_STEPS * np.log2(solids.scales)).astype(np.int64)
    shapes = Shapes(codes, np.zeros_like(codes), np.zeros_like(codes))
    rows, rounds = np.arange(len(codes)), 0
    while len(rows):
        part, near = Solids(*(values[rows] for values in solids)), centres[rows]
        coded = _quantize(part, codes[rows], near)
        for values, own in zip(shapes, coded, strict=True):
            values[rows] = own
        reach, inside = _reach(part, *decode(coded, near))
        rows, reach = rows[~inside], reach[~inside]
        least = np.ceil(SCALE_STEPS * np.log2(np.maximum(reach / (1.0 - SLACK), 1.0))).astype(np.int64)
        widest = reach >= reach.max(axis=1, keepdims=True) if rounds < _ROUNDS else np.True_
        grown = codes[rows] + np.maximum(least, widest)
        codes[rows] = np.maximum.accumulate(grown[:, ::-1], axis=1)[:, ::-1]  # the long axis stays the longest
        rounds += 1
    return shapes


def decode(shapes: Shapes, centres: Array) -> tuple[Table, Table, Table]:
    """Return means (N, 3) [m], unit quaternions (N, 4) wxyz and logarithms of scales (N, 3) of integers."""
    quats = _quats(_middles(shapes.turns, turn_bits(shapes.scales)))
    offsets = shapes.offsets * OFFSET_STEPS * 2.0 ** (shapes.scales / SCALE_STEPS)
    means = centres + np.einsum("nij,nj->ni", quat_to_rotation(quats), offsets)
    log_scales = shapes.scales * (np.log(2.0) / SCALE_STEPS)
    return means.astype(np.float32), quats.astype(np.float32), log_scales.astype(np.float32)


def turn_bits(scales: Ints) -> Ints:
    """Return the bits of X, Y and T (N, 3) that scale codes (N, 3) give: more for larger ratios of scales."""
    tilt = _TILT_BITS[scales[:, 0] - scales[:, 2]]
    return np.stack([tilt, tilt, _TWIST_BITS[scales[:, 0] - scales[:, 1]]], axis=1)


def _bits(steps: float) -> Ints:
    """Return the bits of turns for each difference of two scale codes."""
    ratios = 2.0 ** (np.arange(MAX_CODE - MIN_CODE + 1) / SCALE_STEPS)
    intervals = np.clip(steps * (ratios - 1.0 / ratios), 1.0, 2.0**MAX_TURN_BITS)
    return np.ceil(np.log2(intervals)).astype(np.int64)


_TILT_BITS, _TWIST_BITS = _bits(TILT_STEPS), _bits(TWIST_STEPS)


def _quats(turns: Array) -> Array:
    """Return unit quaternions (N, 4) wxyz of X, Y, T (N, 3)."""
    x, y, t = turns.T
    one, zero = np.ones_like(x), np.zeros_like(x)
    quats = quat_multiply(np.stack([one, -y, x, zero], axis=1), np.stack([one, zero, zero, t], axis=1))
    return quats / np.sqrt((quats**2).sum(axis=1, keepdims=True))


def _quantize(solids: Solids, codes: Ints, centres: Array) -> Shapes:
    """Return the integers nearest to ellipsoids for given scale codes (N, 3)."""
    bits, turns = turn_bits(codes), np.zeros((len(codes), 3), np.int64)
    thin = solids.axes[:, :, 2] * np.where(solids.axes[:, 2:, 2] < 0, -1.0, 1.0)
    turns[:, :2] = _intervals(thin[:, :2] / (1.0 + thin[:, 2:]), bits[:, :2])
    tilted = quat_to_rotation(_quats(_middles(turns, bits) * (1.0, 1.0, 0.0)))
    along = np.einsum("nji,nj->ni", tilted[:, :, :2], solids.axes[:, :, 0])
    angle = np.arctan2(along[:, 1], along[:, 0])
    turns[:, 2] = _intervals(np.tan(0.5 * (angle - np.pi * np.rint(angle / np.pi))), bits[:, 2])
    axes = quat_to_rotation(_quats(_middles(turns, bits)))
    steps = OFFSET_STEPS * 2.0 ** (codes / SCALE_STEPS)
    offsets = np.einsum("nji,nj->ni", axes, solids.means - centres) / steps
    return Shapes(codes, turns, np.rint(offsets).astype(np.int64))


def _intervals(values: Array, bits: Ints) -> Ints:
    """Return the interval of -1..1, halved ``bits`` times, in which each value is."""
    return np.clip(np.floor(np.ldexp(0.5 * values + 0.5, bits)), 0, 2**bits - 1).astype(np.int64)


def _middles(turns: Ints, bits: Ints) -> Array:
    """Return the middles of intervals of -1..1."""
    return np.ldexp(2.0 * turns + 1.0, -bits) - 1.0


def _reach(solids: Solids, means: Table, quats: Table, log_scales: Table) -> tuple[Array, NDArray[np.bool_]]:
    """Return how far ellipsoids reach along the axes of outer ones, in their semi-axes (N, 3), and which are inside.

    With the outer ellipsoid as the unit ball, the inner one is A x + b for all x of the unit ball. For each p > 0, it
    is part of the centred ellipsoid of matrix ``(1 + p) A Aᵀ + (1 + 1 / p) b bᵀ``. So it is inside if this matrix is
    below the identity. At n standard deviations, b is b / n, so that 1 is the hardest case.
    """
    outer, semi_axes = quat_to_rotation(quats), np.exp(log_scales.astype(np.float64))
    A = np.matmul(outer.transpose(0, 2, 1), solids.axes) * solids.scales[:, None, :] / semi_axes[:, :, None]
    b = np.einsum("nji,nj->ni", outer, solids.means - means) / semi_axes
    AA, bb = np.matmul(A, A.transpose(0, 2, 1)), b[:, :, None] * b[:, None, :]
    p = np.maximum(_P_SHARE * np.sqrt((b**2).sum(axis=1)), 1e-9)[:, None, None]
    room = (1.0 - SLACK) ** 2 * np.eye(3) - (1.0 + p) * AA - (1.0 + 1.0 / p) * bb
    return np.sqrt(np.diagonal(AA, axis1=1, axis2=2)) + np.abs(b), _is_positive(room)


def _is_positive(M: Array) -> NDArray[np.bool_]:
    """Return whether symmetric matrices (N, 3, 3) are positive definite: their leading minors are above 0."""
    first = M[:, 0, 0]
    second = first * M[:, 1, 1] - M[:, 0, 1] ** 2
    return (first > 0) & (second > 0) & (np.linalg.det(M) > 0)

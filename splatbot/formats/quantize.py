"""Quantisation that splat formats share: even steps, quaternions by their smallest three components, Morton order."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

Array = NDArray[np.float64]
Codes = NDArray[np.uint32]

# The three other components of a quaternion for each index of the largest one.
_OTHERS = np.array([[1, 2, 3], [0, 2, 3], [0, 1, 3], [0, 1, 2]])


def to_steps(values: ArrayLike, low: ArrayLike, high: ArrayLike, steps: int) -> Codes:
    """Return the nearest of ``steps`` even steps from ``low`` (code 0) to ``high`` (code ``steps``).

    Values inside of the range are at most half a step from their code's value, those outside become its ends. All
    codes are 0 if ``low`` equals ``high``.
    """
    low, high = np.asarray(low, np.float64), np.asarray(high, np.float64)
    width = high - low
    share = (np.asarray(values, np.float64) - low) / np.where(width > 0, width, 1.0)
    return np.floor(np.clip(share, 0.0, 1.0) * steps + 0.5).astype(np.uint32)


def from_steps(codes: NDArray[np.integer], low: ArrayLike, high: ArrayLike, steps: ArrayLike) -> Array:
    """Return the values of codes of :func:`to_steps`."""
    share = codes.astype(np.float64) / np.asarray(steps)
    return np.asarray(low, np.float64) * (1.0 - share) + np.asarray(high, np.float64) * share


def to_smallest_three(quats: NDArray[np.floating]) -> tuple[NDArray[np.int64], Array]:
    """Split unit quaternions (N, 4) into the index of the largest component (N,) and the others (N, 3) times √2.

    The largest component is made positive, so that the others determine it. They are in -1..1.
    """
    largest = np.abs(quats).argmax(axis=1)
    sign = np.where(np.take_along_axis(quats, largest[:, None], axis=1) < 0, -1.0, 1.0)
    others = np.take_along_axis(quats * sign, _OTHERS[largest], axis=1)
    return largest, np.sqrt(2.0) * others


def from_smallest_three(largest: NDArray[np.integer], others: Array) -> Array:
    """Return the quaternions (N, 4) of :func:`to_smallest_three`.

    An error of d in each of the (unscaled) others changes a quaternion by at most 2 √3 d, to first order. The rotation
    changes by twice that angle [rad].
    """
    index, small = largest.astype(np.int64), others / np.sqrt(2.0)
    quats = np.empty((len(others), 4))
    np.put_along_axis(quats, _OTHERS[index], small, axis=1)
    rest = np.sqrt(np.maximum(0.0, 1.0 - (small**2).sum(axis=1)))
    np.put_along_axis(quats, index[:, None], rest[:, None], axis=1)
    return quats


def morton_order(means: NDArray[np.float32]) -> NDArray[np.int64]:
    """Return the order of points (N, 3) along a Morton curve of 2¹⁰ cells a side: neighbours stay together."""
    cells = to_steps(means, means.min(axis=0), means.max(axis=0), 1023).astype(np.int64)
    codes = np.zeros(len(means), np.int64)
    for bit in range(10):
        for axis in range(3):
            codes |= ((cells[:, axis] >> bit) & 1) << (3 * bit + axis)
    return np.argsort(codes, kind="stable")

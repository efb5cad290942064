"""Codebooks of few values for many: of numbers and of vectors."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Values = NDArray[np.float32]
Labels = NDArray[np.int64]

_LLOYD_STEPS = 10
_SAMPLE = 2**18  # numbers that a codebook is fitted to
_DIRECTIONS = 10  # principal directions in which groups of vectors are split


def number_codebook(values: Values, size: int) -> Values:
    """Return at most ``size`` sorted entries for numbers: the least and the largest one, and means of cells between.

    Cells begin with equal shares of the cube root of the density (Panter and Dite 1951). Steps of Lloyd's algorithm
    improve them. With at most ``size`` distinct numbers, the entries are these.
    """
    flat = values.ravel()
    ends = np.array([flat.min(), flat.max()])
    ordered = np.sort(np.concatenate([flat[:: max(1, len(flat) // _SAMPLE)], ends]))
    if len(np.unique(ordered)) <= size:
        distinct = np.unique(flat)
        if len(distinct) <= size:
            return distinct
    sums = np.concatenate([[0.0], np.cumsum(ordered, dtype=np.float64)])
    entries = _dense_quantiles(ordered.astype(np.float64), size)
    for _ in range(_LLOYD_STEPS):
        edges = np.searchsorted(ordered, 0.5 * (entries[1:] + entries[:-1]))
        bounds = np.concatenate([[0], edges, [len(ordered)]])
        counts, totals = np.diff(bounds), np.diff(sums[bounds])
        entries = np.where(counts > 0, totals / np.maximum(counts, 1), entries)
    entries[[0, -1]] = ends
    return np.sort(entries).astype(np.float32)


def nearest_entries(entries: Values, values: Values) -> Labels:
    """Return the index of the entry that is nearest to each value; ``entries`` are sorted."""
    edges = 0.5 * (entries[1:] + entries[:-1])
    return np.searchsorted(edges, values)


def vector_codebook(vectors: Values, size: int) -> tuple[Values, Labels]:
    """Return at most ``size`` vectors for many (N, D), and the index of each one's representative (N,).

    With at most ``size`` distinct vectors, these represent themselves. Else groups are halved at the median of their
    widest principal direction (Heckbert 1982) until they are ``size``, a power of 2. A group's mean represents it.
    """
    rows = np.ascontiguousarray(vectors).view(np.dtype((np.void, vectors.itemsize * vectors.shape[1])))
    _, first, labels = np.unique(rows.ravel(), return_index=True, return_inverse=True)
    if len(first) <= size:
        return vectors[first], labels
    centred = vectors - vectors.mean(axis=0)
    main = np.linalg.eigh(centred.T @ centred)[1][:, -_DIRECTIONS:]
    groups = _median_cut(centred @ main, int(np.log2(size)))
    counts = np.bincount(groups)
    means = np.stack([np.bincount(groups, column) for column in vectors.T], axis=1) / np.maximum(counts, 1)[:, None]
    return means.astype(np.float32), groups


def _dense_quantiles(ordered: NDArray[np.float64], size: int) -> NDArray[np.float64]:
    counts, edges = np.histogram(ordered, bins=16 * size)
    share = np.concatenate([[0.0], np.cumsum(np.cbrt(counts))])
    return np.interp((np.arange(size) + 0.5) / size * share[-1], share, edges)


def _median_cut(points: Values, levels: int) -> Labels:
    """Return the group (N,) of points (N, D) after each group is halved ``levels`` times; N > 2 ** levels."""
    order = np.arange(len(points))
    starts = np.array([0])
    for _ in range(levels):
        ranked = points[order]
        lows = np.minimum.reduceat(ranked, starts)
        widths = np.maximum.reduceat(ranked, starts) - lows
        sizes = np.diff(np.append(starts, len(order)))
        group = np.repeat(np.arange(len(starts)), sizes)
        widest = widths.argmax(axis=1)
        keys = ranked[np.arange(len(order)), widest[group]].astype(np.float64)
        low, width = (part[np.arange(len(starts)), widest][group] for part in (lows, widths))
        order = order[np.argsort(group + 0.5 * (keys - low) / np.where(width > 0, width, 1.0))]
        starts = np.stack([starts, starts + sizes // 2], axis=1).ravel()
    labels = np.empty(len(points), np.int64)
    labels[order] = np.repeat(np.arange(len(starts)), np.diff(np.append(starts, len(order))))
    return labels

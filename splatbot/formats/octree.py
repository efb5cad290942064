"""Points as the leaves of an octree: one byte of occupied children for each node, level by level."""

from __future__ import annotations

from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from splatbot.formats.checks import damaged

Array = NDArray[np.float64]
Ints = NDArray[np.int64]

MAX_DEPTH = 21  # three of its bits make a code of 63 bits
MIN_EXPONENT, MAX_EXPONENT = -20, 22

_COARSEST, _FINEST = 0, -14  # exponents of the edges of leaves
_SINGLE = 0.8  # least number of leaves for each point


class Grid(NamedTuple):
    """Cube that is halved along each axis.

    Args:
        corner: (3,) its least corner [m].
        exponent: its edge is ``2 ** exponent`` m.
        depth: number of times that it is halved.
    """

    corner: Array
    exponent: int
    depth: int

    @property
    def cell(self) -> float:
        """Edge of a leaf [m]."""
        return float(np.ldexp(1.0, self.exponent - self.depth))

    def codes(self, points: Array) -> Ints:
        """Return the Morton codes (N,) of the leaves of points (N, 3) [m]."""
        cells = np.clip(np.floor((points - self.corner) / self.cell), 0, 2**self.depth - 1).astype(np.int64)
        codes = np.zeros(len(points), np.int64)
        for bit in range(self.depth):
            for axis in range(3):
                codes |= (cells[:, axis] >> bit & 1) << (3 * bit + axis)
        return codes

    def centres(self, codes: Ints) -> Array:
        """Return the centres (N, 3) [m] of the leaves of Morton codes (N,)."""
        cells = np.zeros((len(codes), 3), np.int64)
        for bit in range(self.depth):
            for axis in range(3):
                cells[:, axis] |= (codes >> (3 * bit + axis) & 1) << bit
        return self.corner + (cells + 0.5) * self.cell


def grid_order(points: Array) -> tuple[Grid, Ints, Ints]:
    """Return a grid for points (N, 3) [m], their order along its Morton curve, and their codes in this order.

    Leaves are at most 1 m wide, and otherwise the widest of which there are 0.8 for each point.
    """
    corner = points.min(axis=0)
    exponent = max(MIN_EXPONENT, int(np.frexp((points - corner).max())[1]))
    codes = Grid(corner, exponent, MAX_DEPTH).codes(points)
    order = np.argsort(codes, kind="stable")
    depth = max(0, exponent - _COARSEST)
    while True:
        leaves = codes[order] >> 3 * (MAX_DEPTH - depth)
        is_single = 1 + np.count_nonzero(np.diff(leaves)) >= _SINGLE * len(points)
        if is_single or depth == MAX_DEPTH or exponent - depth <= _FINEST:
            return Grid(corner, exponent, depth), order, leaves
        depth += 1


def write_octree(leaves: Ints, depth: int) -> bytes:
    """Return the nodes from the root on for distinct sorted Morton codes; bit i of a byte is child i."""
    levels = []
    for _ in range(depth):
        starts = np.flatnonzero(np.diff(leaves >> 3, prepend=-1))
        levels.append(np.bitwise_or.reduceat(1 << (leaves & 7), starts).astype(np.uint8).tobytes())
        leaves = leaves[starts] >> 3
    return b"".join(levels[::-1])


def read_octree(path: str | Path, nodes: NDArray[np.uint8], depth: int, most: int) -> Ints:
    """Return the Morton codes of at most ``most`` leaves.

    Raises:
        FormatError: the nodes do not fit together, or have more leaves.
    """
    leaves, start = np.zeros(1, np.int64), 0
    for _ in range(depth):
        level = nodes[start : start + len(leaves)]
        children = np.unpackbits(level[:, None], axis=1, bitorder="little")
        if len(level) < len(leaves) or not 0 < np.count_nonzero(children) <= most:
            raise damaged(path, "octree", f"{len(nodes)} nodes")
        start += len(level)
        parents, child = np.nonzero(children)
        leaves = leaves[parents] << 3 | child
    if start < len(nodes):
        raise damaged(path, "octree", f"{len(nodes)} nodes, {start} of them connected")
    return leaves

"""OctoMap binary trees (`.bt`): occupied, free and unknown voxels (Hornung et al., Autonomous Robots 2013).

The format is that of ``octomap::OcTree::writeBinary``: a text header, then each inner node as two bytes, depth first.
Two bits describe a child: 00 unknown, 01 free, 10 occupied, 11 inner node.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.atomic import atomic_write
from splatbot.errors import InputError

_DEPTH = 16
_ORIGIN = 1 << (_DEPTH - 1)  # key of the voxel whose lower corner is the origin
_FREE, _OCCUPIED, _INNER = 0b01, 0b10, 0b11


def save_octomap(path: str | Path, keys: NDArray[np.int64], occupied: NDArray[np.bool_], resolution: float) -> None:
    """Write known voxels; all others are unknown.

    Args:
        path: file to write; it is replaced only once the new one is complete.
        keys: (N, 3) integer coordinates: voxel k covers k * resolution to (k + 1) * resolution [m].
        occupied: (N,) True for occupied voxels, False for free ones.
        resolution: edge length of a voxel [m].

    Raises:
        InputError: a voxel is outside of the tree of 65,536 voxels a side, or listed twice.
    """
    shifted = np.asarray(keys, dtype=np.int64) + _ORIGIN
    if shifted.size and (shifted.min() < 0 or shifted.max() >= 1 << _DEPTH):
        raise InputError("is too far from the origin.", field="keys", hint="use a larger resolution")
    codes, states = _morton(shifted), np.where(occupied, _OCCUPIED, _FREE).astype(np.uint8)
    order = np.argsort(codes)
    codes, states = codes[order], states[order]
    if (np.diff(codes) == 0).any():
        raise InputError("has a voxel twice.", field="keys", hint="list each voxel once")
    levels = _levels(codes, states)
    nodes = 1 + sum(len(codes) for codes, _ in levels)
    header = f"# Octomap OcTree binary file\nid OcTree\nsize {nodes if len(keys) else 0}\nres {resolution:g}\ndata\n"
    with atomic_write(path) as file:
        file.write(header.encode())
        if len(keys):
            file.write(_depth_first(levels))


def _morton(keys: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return keys (N, 3) with interleaved bits: three bits a level from the root, x in the lowest."""
    codes = np.zeros(len(keys), np.int64)
    for bit in range(_DEPTH):
        for axis in range(3):
            codes |= ((keys[:, axis] >> bit) & 1) << (3 * bit + axis)
    return codes


def _levels(codes: NDArray[np.int64], states: NDArray[np.uint8]) -> list[tuple[NDArray[np.int64], NDArray[np.uint8]]]:
    """Return sorted codes and states of the nodes of each level, below the root first; equal siblings are merged."""
    levels = [(codes, states)]
    for _ in range(_DEPTH - 1):
        codes, states = levels[0]
        parents, first, count = np.unique(codes >> 3, return_index=True, return_counts=True)
        same = np.minimum.reduceat(states, first) == np.maximum.reduceat(states, first)
        merged = (count == 8) & same & (states[first] != _INNER)
        levels[0] = (codes[~np.repeat(merged, count)], states[~np.repeat(merged, count)])
        levels.insert(0, (parents, np.where(merged, states[first], _INNER).astype(np.uint8)))
    return levels


def _depth_first(levels: list[tuple[NDArray[np.int64], NDArray[np.uint8]]]) -> bytes:
    """Return the two bytes of each inner node in depth-first order."""
    keys, words = [], []
    for depth, (codes, states) in enumerate(levels):
        parents, first = np.unique(codes >> 3, return_index=True)
        bits = states.astype(np.uint32) << (2 * (codes & 7)).astype(np.uint32)
        words.append(np.bitwise_or.reduceat(bits, first).astype("<u2"))
        # depth first: by the code of the first leaf below the node, then by depth
        keys.append(((parents << (3 * (_DEPTH - depth))) << 5) | depth)
    order = np.argsort(np.concatenate(keys), kind="stable")
    return np.concatenate(words)[order].tobytes()

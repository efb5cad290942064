"""Meshes and octrees for python-fcl, the peer of the collision field in benchmarks. Requires python-fcl."""

from __future__ import annotations

import importlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.protocols import Array


def fcl_mesh(vertices: Array, triangles: NDArray[Any]) -> Any:
    """Build a bounding volume hierarchy of vertices (V, 3) [m] and triangles (T, 3).

    Raises:
        ImportError: python-fcl is not installed.
    """
    model = importlib.import_module("fcl").BVHModel()
    model.beginModel(len(vertices), len(triangles))
    model.addSubModel(vertices, triangles)
    model.endModel()
    return model


def fcl_octree(points: Array, voxel: float) -> Any:
    """Build an octree whose occupied voxels, of edge ``voxel`` [m], contain the points (P, 3) [m].

    Raises:
        ImportError: python-fcl is not installed.
    """
    data = octomap_bytes(points, voxel)  # python-fcl reads signed bytes
    return importlib.import_module("fcl").OcTree(voxel, np.frombuffer(data, np.int8).tolist())


def octomap_bytes(points: Array, voxel: float) -> bytes:
    """Serialize the occupied voxels of points (P, 3) [m] as OctoMap's binary tree of 16 levels (Hornung et al. 2013).

    A node has two bytes, two bits per child: (0, 0) unknown, (0, 1) occupied, (1, 1) inner node, in depth-first order.
    """
    keys = np.unique(np.floor(points / voxel).astype(np.int64) + (1 << 15), axis=0)
    found = bytearray()

    def write(part: NDArray[np.int64], level: int) -> None:
        bits = (part >> level) & 1
        child = bits[:, 0] + 2 * bits[:, 1] + 4 * bits[:, 2]
        present = [part[child == i] for i in range(8)]
        word = sum((0b10 if level == 0 else 0b11) << (2 * i) for i in range(8) if len(present[i]))
        found.extend(word.to_bytes(2, "little"))
        for below in present:
            if level and len(below):
                write(below, level - 1)

    write(keys, 15)
    return bytes(found)

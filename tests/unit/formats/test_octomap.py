"""OctoMap files, read by a reader that follows octomap's readBinaryNode."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.formats.octomap import save_octomap

Leaves = dict[tuple[int, int, int], bool]


def read_bt(path: Path) -> tuple[float, int, Leaves]:
    """Return resolution, number of nodes in the header, and each voxel of the finest level with its occupancy."""
    data = path.read_bytes()
    header, _, body = data.partition(b"data\n")
    fields = dict(line.split(b" ", 1) for line in header.splitlines()[1:])
    assert header.startswith(b"# Octomap OcTree binary file")
    assert fields[b"id"] == b"OcTree"
    found: Leaves = {}
    position = nodes = 0

    def fill(key: tuple[int, int, int], side: int, occupied: bool) -> None:
        for step in np.ndindex(side, side, side):
            x, y, z = (k + s - 32768 for k, s in zip(key, step, strict=True))
            found[x, y, z] = occupied

    def node(key: tuple[int, int, int], side: int) -> None:
        nonlocal position, nodes
        nodes += 1
        bits = int.from_bytes(body[position : position + 2], "little")
        position += 2
        inner = []
        for child in range(8):
            state, half = bits >> (2 * child) & 3, side // 2
            x, y, z = (k + half * (child >> axis & 1) for axis, k in enumerate(key))
            if state == 3:
                inner.append((x, y, z))
            elif state:
                nodes += 1
                fill((x, y, z), half, state == 2)
        for place in inner:
            node(place, side // 2)

    if body:
        node((0, 0, 0), 65536)
    assert position == len(body)
    assert nodes == int(fields[b"size"])
    return float(fields[b"res"]), nodes, found


def test_every_voxel_is_read_back_with_its_state(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    keys = np.unique(rng.integers(-20, 20, (3000, 3)), axis=0)
    occupied = rng.random(len(keys)) < 0.5
    save_octomap(tmp_path / "a.bt", keys, occupied, 0.05)
    resolution, _, found = read_bt(tmp_path / "a.bt")
    assert resolution == 0.05
    assert found == {tuple(k): bool(o) for k, o in zip(keys.tolist(), occupied, strict=True)}


def test_equal_neighbours_become_one_node(tmp_path: Path) -> None:
    cube = np.moveaxis(np.indices((8, 8, 8)), 0, -1).reshape(-1, 3)
    save_octomap(tmp_path / "a.bt", cube, np.ones(len(cube), np.bool_), 0.1)
    _, nodes, found = read_bt(tmp_path / "a.bt")
    assert len(found) == 512
    assert nodes == 1 + 13  # the root, and one node a level down to the cube of 8 voxels a side


def test_an_empty_tree_and_wrong_voxels(tmp_path: Path) -> None:
    save_octomap(tmp_path / "a.bt", np.zeros((0, 3), np.int64), np.zeros(0, np.bool_), 0.1)
    assert read_bt(tmp_path / "a.bt")[2] == {}
    for keys in ([[40000, 0, 0]], [[1, 2, 3], [1, 2, 3]]):
        with pytest.raises(InputError):
            save_octomap(tmp_path / "b.bt", np.array(keys), np.ones(len(keys), np.bool_), 0.1)
    assert not (tmp_path / "b.bt").exists()

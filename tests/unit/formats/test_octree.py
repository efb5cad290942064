"""Octree of points: known nodes, round trips, and damaged nodes."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.errors import FormatError
from splatbot.formats.octree import MAX_DEPTH, Grid, grid_order, read_octree, write_octree


def read(nodes: bytes, depth: int, most: int = 1000) -> list[int]:
    return read_octree("a.sbz", np.frombuffer(nodes, np.uint8), depth, most).tolist()


def test_nodes_are_the_occupied_children_level_by_level() -> None:
    leaves = np.array([0o00, 0o03, 0o70])
    assert write_octree(leaves, 2) == bytes([0b10000001, 0b00001001, 0b00000001])
    assert read(write_octree(leaves, 2), 2) == leaves.tolist()
    assert write_octree(np.array([0]), 0) == b""
    assert read(b"", 0) == [0]


@pytest.mark.parametrize("depth", [1, 5, MAX_DEPTH])
def test_leaves_survive(rng: np.random.Generator, depth: int) -> None:
    leaves = np.unique(rng.integers(0, 8**depth, 500))
    assert read(write_octree(leaves, depth), depth) == leaves.tolist()


def test_cells_hold_their_points(rng: np.random.Generator) -> None:
    points = rng.uniform(-3.0, 5.0, (1000, 3))
    grid, order, leaves = grid_order(points)
    assert (np.diff(leaves) >= 0).all()
    assert (np.abs(grid.centres(leaves) - points[order]) <= 0.5 * grid.cell + 1e-12).all()
    assert len(np.unique(leaves)) >= 800
    wider = Grid(grid.corner, grid.exponent, grid.depth - 1)
    assert len(np.unique(wider.codes(points))) < 800


@pytest.mark.parametrize("shift", [0.0, 1e6])
def test_equal_points_have_one_leaf(shift: float) -> None:
    grid, _, leaves = grid_order(np.full((5, 3), shift))
    assert leaves.tolist() == [0] * 5
    assert np.abs(grid.centres(leaves) - shift).max() <= grid.cell <= 1.0


@pytest.mark.parametrize(
    ("nodes", "depth"),
    [(b"", 1), (b"\0", 1), (b"\1", 2), (b"\1\0", 2), (b"\1\1", 1), (b"\xff" + b"\xff" * 8, 2), (b"\3\1", 2)],
)
def test_damaged_nodes_are_refused(nodes: bytes, depth: int) -> None:
    with pytest.raises(FormatError, match="damaged") as caught:
        read(nodes, depth, most=60)
    assert (caught.value.file, caught.value.field) == ("a.sbz", "octree")

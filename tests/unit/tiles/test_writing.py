"""The tree of tiles: all Gaussians once, bounded tiles for the worst maps, and files that are whole or not there."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch

from splatbot.errors import InputError
from splatbot.failpoints import VARIABLE
from splatbot.gaussians import GaussianModel
from splatbot.tiles import TiledMap, write_tiles
from splatbot.tiles.index import TileIndex
from splatbot.workspace import Workspace, find_workspace
from tests.unit.tiles.maps import COLUMNS, assert_equal, building

EVERYWHERE = np.full(3, 2e6)


def leaf_counts(index: TileIndex) -> list[int]:
    return [tile.count for tile in index.tiles if not tile.children]


@pytest.mark.parametrize("degree", [0, 3])
def test_the_leaves_have_each_gaussian_once_bit_for_bit_in_order(tmp_path: Path, degree: int) -> None:
    model = building(3000, degree=degree)
    index = write_tiles(model, tmp_path, tile_gaussians=200)
    assert max(leaf_counts(index)) <= 200
    with TiledMap(tmp_path) as tiles:
        part = tiles.near(-EVERYWHERE, EVERYWHERE)
    assert_equal(part.model, model)
    assert part.rows.tolist() == list(range(3000))


def test_the_bounds_of_each_tile_hold_its_gaussians(tmp_path: Path) -> None:
    model = building(2000)
    index = write_tiles(model, tmp_path, tile_gaussians=150)
    with TiledMap(tmp_path) as tiles:
        for number, tile in enumerate(index.tiles):
            part = tiles._load(number).model
            assert (part.means.numpy() >= np.array(tile.low, np.float32)).all()
            assert (part.means.numpy() <= np.array(tile.high, np.float32)).all()
            assert float(part.scales.max()) <= tile.scale * (1 + 1e-6)


def test_each_parent_has_about_the_gaussians_of_one_child(tmp_path: Path) -> None:
    index = write_tiles(building(4000), tmp_path, tile_gaussians=250)
    parents = [tile for tile in index.tiles if tile.children]
    assert parents
    for tile in parents:
        assert tile.count <= max(index.tiles[child].count for child in tile.children)
        assert tile.error >= max(index.tiles[child].error for child in tile.children)


@pytest.mark.parametrize("seed", range(3))
def test_bounds_and_scales_of_parents_enclose_those_of_their_children(tmp_path: Path, seed: int) -> None:
    model = building(3000, seed=seed)
    model.log_scales[::300] += np.log(30.0)
    index = write_tiles(model, tmp_path, tile_gaussians=200)
    for tile in index.tiles:
        for child in (index.tiles[number] for number in tile.children):
            assert (np.array(tile.low) <= child.low).all()
            assert (np.array(tile.high) >= child.high).all()
            assert tile.scale >= child.scale


def test_a_model_that_is_optimized_is_written(tmp_path: Path) -> None:
    model = building(300)
    model.means.requires_grad_()
    write_tiles(model, tmp_path, tile_gaussians=100)
    with TiledMap(tmp_path) as tiles:
        assert torch.equal(tiles.near(-EVERYWHERE, EVERYWHERE).model.means, model.means.detach())


def test_the_scene_of_a_map_is_written_with_its_tiles(tmp_path: Path) -> None:
    scene = Workspace(joint_offsets=np.array([0.0, 0.1]), offsets_of="arm")
    write_tiles(building(100), tmp_path, workspace=scene)
    found = find_workspace(tmp_path)
    assert found is not None
    assert found.joint_offsets is not None
    assert found.joint_offsets.tolist() == [0.0, 0.1]


def test_a_map_of_more_tiles_than_an_index_may_have_is_refused(tmp_path: Path) -> None:
    model = building(1)
    many = GaussianModel(*(getattr(model, name).expand(1_700_000, *getattr(model, name).shape[1:]) for name in COLUMNS))
    with pytest.raises(InputError, match="69 or more") as caught:
        write_tiles(many, tmp_path / "tiles", tile_gaussians=64)
    assert caught.value.field == "tile_gaussians"
    assert not (tmp_path / "tiles").exists()


@pytest.mark.parametrize("kind", ["one place", "a lattice", "a line"])
def test_gaussians_at_equal_places_and_on_borders_fill_bounded_tiles(tmp_path: Path, kind: str) -> None:
    n = 2048
    means = np.zeros((n, 3))
    if kind == "a lattice":
        means = np.stack(np.unravel_index(np.arange(n), (16, 16, 8)), axis=1).astype(float)
    elif kind == "a line":
        means[:, 1] = np.arange(n) // 2
    model = GaussianModel.from_activated(
        means=means,
        quats=np.tile((1.0, 0.0, 0.0, 0.0), (n, 1)),
        scales=np.full((n, 3), 0.01),
        opacities=np.full(n, 0.5),
        colors=np.full((n, 3), 0.5),
    )
    index = write_tiles(model, tmp_path, tile_gaussians=128)
    assert max(leaf_counts(index)) <= 128
    with TiledMap(tmp_path) as tiles:
        assert_equal(tiles.near(-EVERYWHERE, EVERYWHERE).model, model)
        border = means[n // 2]
        found = tiles.near(border, border).rows.tolist()
    assert found == np.flatnonzero((np.abs(means - border) <= 0.02).all(axis=1)).tolist()


def test_an_outlier_at_1e6_m_adds_no_tiles(tmp_path: Path) -> None:
    model = building(2000)
    usual = write_tiles(model, tmp_path / "usual", tile_gaussians=250)
    model.means[7] = torch.tensor([1e6, -1e6, 1e6])
    index = write_tiles(model, tmp_path / "outlier", tile_gaussians=250)
    assert len(index.tiles) == len(usual.tiles)
    with TiledMap(tmp_path / "outlier") as tiles:
        far = tiles.near([1e6 - 1, -1e6 - 1, 1e6 - 1], [1e6, -1e6, 1e6])
        assert far.rows.tolist() == [7]
        tiles.near([5.0, 5.0, 0.0], [6.0, 6.0, 1.0])
        assert tiles.loads < len(leaf_counts(index))  # the others are as small as without the outlier


def test_wide_gaussians_do_not_enlarge_the_tiles_of_others(tmp_path: Path) -> None:
    model = building(4000)
    model.log_scales[::400] = np.log(30.0)
    index = write_tiles(model, tmp_path, tile_gaussians=250)
    wide = [tile for tile in index.tiles if not tile.children and tile.scale > 1.0]
    assert sum(tile.count for tile in wide) == 10
    with TiledMap(tmp_path) as tiles:
        found = tiles.near([1.0, 1.0, 1.0], [1.1, 1.1, 1.1]).rows
        assert set(range(0, 4000, 400)) <= set(found.tolist())
        assert tiles.loads < len(leaf_counts(index)) / 2


def test_an_empty_map_has_no_tiles(tmp_path: Path) -> None:
    assert write_tiles(GaussianModel.empty(2), tmp_path).tiles == ()


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("means", np.nan),
        ("means", 2e6),
        ("log_scales", np.inf),
        ("opacity_logits", np.nan),
        ("sh", -np.inf),
        ("quats", 0),
    ],
)
def test_damaged_gaussians_are_refused_by_row_and_field(tmp_path: Path, name: str, value: float) -> None:
    model = building(300)
    getattr(model, name)[123] = value
    with pytest.raises(InputError, match="row 123") as caught:
        write_tiles(model, tmp_path / "tiles")
    assert caught.value.field == name
    assert not (tmp_path / "tiles").exists()


@pytest.mark.parametrize("count", [0, 63, 1_000_001])
def test_a_size_of_tiles_out_of_range_is_refused(tmp_path: Path, count: int) -> None:
    with pytest.raises(InputError, match="tile_gaussians"):
        write_tiles(building(10), tmp_path, tile_gaussians=count)


WRITE = """
import sys
from splatbot.tiles import write_tiles
from tests.unit.tiles.maps import building
write_tiles(building(700, seed=1), sys.argv[1], tile_gaussians=100)
"""


@pytest.mark.parametrize("point", ["rename:1", "rename:3"])
def test_a_killed_process_leaves_the_earlier_map_or_none_and_drafts_that_the_next_writer_removes(
    tmp_path: Path, point: str
) -> None:
    write_tiles(building(600), tmp_path, tile_gaussians=100)
    killed = subprocess.run(
        [sys.executable, "-c", WRITE, str(tmp_path)], env={**os.environ, VARIABLE: point}, check=False
    )
    assert killed.returncode == -signal.SIGKILL
    if point == "rename:3":  # the earlier index is gone before its data is replaced
        assert not (tmp_path / "tiles.json").exists()
    else:
        with TiledMap(tmp_path) as tiles:
            assert_equal(tiles.near(-EVERYWHERE, EVERYWHERE).model, building(600))
    assert any(tmp_path.glob(".*.draft"))
    write_tiles(building(600), tmp_path, tile_gaussians=100)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["tiles.bin", "tiles.json"]

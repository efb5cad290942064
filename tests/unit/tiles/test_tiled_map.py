"""Queries of a tiled map: answers of the whole map from a bounded memory."""

from __future__ import annotations

import os
import shutil
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest
import torch

from splatbot.camera import Camera
from splatbot.collision import GaussianCollisionField
from splatbot.errors import InputError
from splatbot.evaluation.image import psnr
from splatbot.gaussians import GaussianModel
from splatbot.geometry import look_at
from splatbot.rasterize.views import render_view
from splatbot.tiles import TiledMap, write_tiles
from splatbot.tiles.part import bytes_each
from tests.unit.tiles.maps import HEIGHT, SIDE, Array, assert_equal, boxes_of, building
from tests.unit.tiles.test_index import rewrite

N, TILE = 12_000, 500
CAMERA = Camera(160.0, 150.0, 82.0, 55.0, 160, 120)
LOW, HIGH = np.array([3.5, 3.5, -0.1]), np.array([5.5, 5.0, 1.4])


@pytest.fixture(scope="module")
def model() -> GaussianModel:
    """A building with some wide Gaussians, some nearly transparent ones, and an outlier."""
    model = building(N, degree=1)
    model.log_scales[::1500] += np.log(60.0)
    model.opacity_logits[::7] = -7.0
    model.means[11] = torch.tensor([9e5, 0.0, 0.0])
    return model


@pytest.fixture(scope="module")
def folder(model: GaussianModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tiles")
    write_tiles(model, folder, tile_gaussians=TILE)
    return folder


def spheres_in(low: Array, high: Array, count: int, *, radius: float = 0.15, seed: int = 0) -> Array:
    rng = np.random.default_rng(seed)
    radii = rng.uniform(0.0, radius, count)
    return np.column_stack([rng.uniform(low + radius, high - radius, (count, 3)), radii])


@pytest.mark.parametrize("n_sigma", [0.5, 1.0, 2.0, 3.0])
def test_no_ellipsoid_that_reaches_into_the_box_is_missing(model: GaussianModel, folder: Path, n_sigma: float) -> None:
    low, high = boxes_of(model, n_sigma)
    inside = np.flatnonzero(((low <= HIGH) & (high >= LOW)).all(axis=1))
    with TiledMap(folder) as tiles:
        part = tiles.near(LOW, HIGH, n_sigma)
        assert tiles.loads < sum(not tile.children for tile in tiles.index.tiles)
    assert len(inside) > 100
    assert set(inside.tolist()) <= set(part.rows.tolist())
    assert len(part) < N / 4
    assert part.rows.tolist() == sorted(part.rows.tolist())
    assert_equal(part.model, model.select(part.rows.long()))


@pytest.mark.parametrize("n_sigma", [1.0, 2.0, 3.0])
def test_verdicts_in_a_box_are_those_of_the_whole_map(model: GaussianModel, folder: Path, n_sigma: float) -> None:
    spheres = spheres_in(LOW, HIGH, 20_000)
    with TiledMap(folder) as tiles:
        found = tiles.field(LOW, HIGH, n_sigma).in_collision(spheres)
    expected = GaussianCollisionField(model, n_sigma).in_collision(spheres)
    assert 100 < expected.sum() < len(spheres)
    assert (found == expected).all()


def test_an_ellipsoid_as_near_to_a_box_as_float32_resolves_is_loaded(tmp_path: Path) -> None:
    model = GaussianModel.from_activated(
        means=np.array([[3000.0, 0.0, 0.0], [2999.0, 0.0, 0.0]]),
        quats=np.array([[1.0, 0.0, 0.0, 0.0]] * 2),
        scales=np.full((2, 3), 0.01),
        opacities=np.full(2, 0.9),
        colors=np.full((2, 3), 0.5),
    )
    write_tiles(model, tmp_path)
    corner = np.array([3000.02 + 2.0 * float(np.spacing(np.float32(3000.0))), 0.0, 0.0])
    with TiledMap(tmp_path) as tiles:
        assert tiles.near(corner, corner + 0.1).rows.tolist() == [0]


def test_distances_up_to_the_reach_are_those_of_the_whole_map(model: GaussianModel, folder: Path) -> None:
    spheres = spheres_in(LOW, HIGH, 5000)
    with TiledMap(folder) as tiles:
        found = tiles.field(LOW, HIGH, reach=0.1).clearance(spheres)
    expected = GaussianCollisionField(model).clearance(spheres, cut=0.1)
    assert 0 < np.isinf(found.distance).sum() < len(spheres)
    for name in ("distance", "gradient", "witness", "index"):
        assert np.array_equal(getattr(found, name), getattr(expected, name), equal_nan=True), name
    assert set(found.index[np.isinf(found.distance)].tolist()) == {-1}


def test_spheres_that_leave_the_box_are_refused_by_row(folder: Path) -> None:
    with TiledMap(folder) as tiles:
        field = tiles.field(LOW, HIGH)
    inside = 0.5 * (LOW + HIGH)
    for out in ([*inside, 5.0], [*(HIGH + 0.01), 0.0]):
        with pytest.raises(InputError, match="row 1"):
            field.in_collision([[*inside, 0.1], out])
        with pytest.raises(InputError, match="row 1"):
            field.clearance([[*inside, 0.1], out])


def test_a_box_outside_of_the_map_is_free(folder: Path) -> None:
    with TiledMap(folder) as tiles:
        assert not tiles.field([-500, -500, -500], [-400, -400, -400]).in_collision([[-450, -450, -450, 20.0]]).any()
        assert tiles.loads == 0


@pytest.mark.parametrize(
    ("low", "high", "n_sigma"),
    [
        ([0, 0, 0], [1, 1, np.nan], 2.0),
        ([0, 0, 2], [1, 1, 1], 2.0),
        ([0, 0], [1, 1], 2.0),
        ([0, 0, 0], [1, 1, 1], np.nan),
        ([0, 0, 0], [1, 1, 1], -1.0),
    ],
)
def test_boxes_that_are_none_are_refused(folder: Path, low: list[float], high: list[float], n_sigma: float) -> None:
    with TiledMap(folder) as tiles, pytest.raises(InputError):
        tiles.near(low, high, n_sigma)


def poses() -> list[Array]:
    """Return poses inside of rooms, above the building, and far away that face it or not."""
    rng = np.random.default_rng(5)
    eyes = [*rng.uniform((0, 0, 0.2), (SIDE, SIDE, HEIGHT - 0.2), (12, 3)), np.array([-9.0, -9.0, 12.0])]
    targets = [*rng.uniform((0, 0, 0), (SIDE, SIDE, HEIGHT), (12, 3)), np.array([6.0, 6.0, 1.0])]
    away = look_at(np.array([-9.0, -9.0, 5.0]), np.array([-20.0, -21.0, 5.0]))
    return [look_at(eye, target) for eye, target in zip(eyes, targets, strict=True)] + [away]


def test_an_exact_view_is_that_of_the_whole_map_bit_for_bit(model: GaussianModel, folder: Path) -> None:
    counts = []
    with TiledMap(folder) as tiles:
        for T in poses():
            view = tiles.in_view(CAMERA, T, pixel_error=0.0)
            assert view.pixel_error == 0.0
            assert_equal(view.model, model.select(view.rows.long()))
            for mode in ("rgb", "depth"):
                found, expected = (render_view(m, CAMERA, T, mode) for m in (view.model, model))
                assert np.array_equal(found, expected)
            counts.append(len(view.model))
    assert min(counts) < N / 2  # tiles out of view are left out


def test_an_exact_view_of_a_folder_whose_bounds_are_not_nested_is_that_of_the_whole_map(
    model: GaussianModel, folder: Path, tmp_path: Path
) -> None:
    shutil.copytree(folder, tmp_path / "tiles")
    place = [9e5, 9e5, 9e5]
    rewrite(tmp_path / "tiles", lambda body: body["tiles"][-1].update(low=place, high=place, scale=0.0))
    with TiledMap(tmp_path / "tiles") as tiles:
        view = tiles.in_view(CAMERA, poses()[0], pixel_error=0.0)
    assert len(view.model) > 100
    assert_equal(view.model, model.select(view.rows.long()))


def test_a_far_view_has_few_gaussians_and_no_more_error_than_the_whole_map(tmp_path: Path) -> None:
    model = building(30_000, size=0.04)
    write_tiles(model, tmp_path, tile_gaussians=1000)
    T = look_at(np.array([-40.0, -40.0, 60.0]), np.array([6.0, 6.0, 1.0]))
    large = render_view(model, CAMERA.resized(640, 480), T).reshape(120, 4, 160, 4, 3).mean(axis=(1, 3))
    with TiledMap(tmp_path) as tiles:
        view = tiles.in_view(CAMERA, T)
        coarse = tiles.in_view(CAMERA, T, pixel_error=8.0)
    assert 0.0 < view.pixel_error <= 1.0
    assert len(coarse.model) < len(view.model) < len(model) / 2
    expected = psnr(render_view(model, CAMERA, T), large)
    assert psnr(render_view(view.model, CAMERA, T), large) > expected - 0.1


def test_a_view_that_memory_cannot_refine_states_its_error(folder: Path) -> None:
    T = poses()[0]
    least = 2.5 * TILE * bytes_each(4) / 1e6
    with TiledMap(folder, memory_mb=least) as small, TiledMap(folder) as large:
        found, exact = small.in_view(CAMERA, T, pixel_error=0.5), large.in_view(CAMERA, T, pixel_error=0.5)
    assert exact.pixel_error <= 0.5 < found.pixel_error
    assert found.model.nbytes <= 1e6 * least


def test_the_memory_of_tiles_stays_bounded_and_recent_tiles_are_not_read_again(folder: Path) -> None:
    memory_mb = 4 * TILE * bytes_each(4) / 1e6
    rng = np.random.default_rng(1)
    with TiledMap(folder, memory_mb=memory_mb) as tiles:
        for T in poses():
            tiles.in_view(CAMERA, T)
            assert tiles.nbytes <= 1e6 * memory_mb
        for corner in rng.uniform((0, 0, 0), (SIDE, SIDE, HEIGHT), (30, 3)):
            tiles.near(corner, corner + 0.05)
            assert 0 < tiles.nbytes <= 1e6 * memory_mb
        loads, hits = tiles.loads, tiles.hits
        tiles.near(corner, corner + 0.05)
        assert tiles.loads == loads
        assert tiles.hits > hits


def test_a_box_of_more_tiles_than_the_memory_is_refused_before_any_is_read(folder: Path) -> None:
    with TiledMap(folder, memory_mb=4 * TILE * bytes_each(4) / 1e6) as tiles:
        with pytest.raises(InputError, match="memory_mb"):
            tiles.near([-1, -1, -1], [SIDE, SIDE, HEIGHT])
        assert tiles.loads == 0


@pytest.mark.parametrize("memory_mb", [0.0, -1.0, np.nan, np.inf, 1e-3])
def test_a_memory_that_holds_no_tile_is_refused(folder: Path, memory_mb: float) -> None:
    with pytest.raises(InputError, match="memory_mb"):
        TiledMap(folder, memory_mb=memory_mb)


@pytest.mark.parametrize("pixel_error", [-0.1, np.nan, np.inf])
def test_a_pixel_error_out_of_range_is_refused(folder: Path, pixel_error: float) -> None:
    with TiledMap(folder) as tiles, pytest.raises(InputError, match="pixel_error"):
        tiles.in_view(CAMERA, np.eye(4), pixel_error=pixel_error)


def test_threads_share_a_map(model: GaussianModel, folder: Path) -> None:
    corners = np.random.default_rng(2).uniform((0, 0, 0), (SIDE, SIDE, HEIGHT), (40, 3))
    with TiledMap(folder, memory_mb=4 * TILE * bytes_each(4) / 1e6) as tiles, ThreadPoolExecutor(4) as pool:
        parts = list(pool.map(lambda corner: tiles.near(corner, corner + 0.02), corners))
    for part in parts:
        assert_equal(part.model, model.select(part.rows.long()))
    assert sum(len(part) for part in parts) > 0


def test_an_empty_map_answers(tmp_path: Path) -> None:
    write_tiles(GaussianModel.empty(1), tmp_path)
    with TiledMap(tmp_path) as tiles:
        assert len(tiles) == 0
        assert not tiles.field([0, 0, 0], [1, 1, 1]).in_collision([[0.5, 0.5, 0.5]]).any()
        assert len(tiles.in_view(CAMERA, np.eye(4)).model) == 0
        assert tiles.overview().sh_degree == 1


def test_a_closed_map_answers_no_more(folder: Path) -> None:
    tiles = TiledMap(folder)
    tiles.close()
    tiles.close()
    with pytest.raises(OSError, match="descriptor"):
        tiles.overview()


def test_the_file_is_closed_with_the_last_reference_to_the_map(folder: Path) -> None:
    tiles = TiledMap(folder)
    descriptor = tiles._file
    os.fstat(descriptor)
    del tiles
    with pytest.raises(OSError, match="descriptor"):
        os.fstat(descriptor)

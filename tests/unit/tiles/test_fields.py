"""Shared fields of a tiled map: one for each place, within a bounded memory."""

from __future__ import annotations

import threading
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import numpy as np
import pytest

from splatbot.collision import GaussianCollisionField
from splatbot.errors import FormatError, InputError
from splatbot.gaussians import GaussianModel
from splatbot.tiles import TiledField, TiledMap, write_tiles
from splatbot.tiles.fields import FieldCache, FieldKey
from tests.unit.tiles.maps import building

PLACES = [(float(x), float(y), 0.2) for x in (2.2, 5.2, 8.2) for y in (2.2, 5.2, 8.2)]


@pytest.fixture(scope="module")
def model() -> GaussianModel:
    return building(12_000)


@pytest.fixture(scope="module")
def folder(model: GaussianModel, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tiles")
    write_tiles(model, folder, tile_gaussians=500)
    return folder


def key(number: int) -> FieldKey:
    return (float(number),) * 3, (number + 1.0,) * 3, 2.0, 0.0


def test_boxes_in_the_same_cells_share_one_field_and_others_do_not(folder: Path) -> None:
    with TiledMap(folder) as tiles:
        first = tiles.shared_field((4.1, 4.1, 0.1), (4.2, 4.2, 0.2), reach=0.2)
        assert tiles.shared_field((4.3, 4.0, -0.0), (4.4, 4.4, 0.4), reach=0.2) is first
        assert tiles.fields.builds == 1
        for low, n_sigma, reach in (
            ((3.9, 4.1, 0.1), 2.0, 0.2),
            ((4.1, 4.1, 0.1), 1.0, 0.2),
            ((4.1, 4.1, 0.1), 2.0, 0.3),
        ):
            assert tiles.shared_field(low, (4.2, 4.2, 0.2), n_sigma, reach=reach) is not first
        assert tiles.fields.builds == 4


def test_answers_of_a_shared_field_are_those_of_the_whole_map(model: GaussianModel, folder: Path) -> None:
    low, high = np.array([-0.3, 3.6, -0.2]), np.array([0.8, 4.5, 0.7])
    points = np.random.default_rng(0).uniform(low, high, (2000, 3))
    points[:200, 2] = 0.0  # on the floor
    whole = GaussianCollisionField(model)
    with TiledMap(folder) as tiles:
        found = tiles.shared_field(low, high, reach=0.5)
        shared, known = found.clearance(points), found.mahalanobis(points)
    expected = whole.clearance(points, cut=0.5)
    np.testing.assert_array_equal(shared.distance, expected.distance)
    np.testing.assert_array_equal(shared.index, expected.index)
    inside = whole.mahalanobis(points).distance <= whole.n_sigma
    assert 0 < inside.sum() < len(points)
    np.testing.assert_array_equal(known.distance <= whole.n_sigma, inside)


def test_mahalanobis_distances_on_the_surfaces_are_those_of_the_whole_map(model: GaussianModel, folder: Path) -> None:
    low, high = np.array([3.0, 3.6, -0.2]), np.array([5.0, 5.5, 0.7])
    whole = GaussianCollisionField(model)
    rng = np.random.default_rng(1)
    nearest = whole.clearance(rng.uniform(low, high, (4000, 3)), cut=0.5)
    surface = nearest.witness + rng.choice((-1e-6, 1e-8, 1e-6, 1e-5), (4000, 1)) * nearest.gradient
    surface = surface[((surface > low) & (surface < high)).all(axis=1)]
    expected = whole.mahalanobis(surface)
    inside = expected.distance <= whole.n_sigma
    assert 100 < inside.sum() < len(surface) - 100
    with TiledMap(folder) as tiles:
        field = tiles.shared_field(low, high, reach=0.5)
        found = field.mahalanobis(surface)
        with pytest.raises(InputError, match=r"points"):
            field.mahalanobis(np.column_stack([surface, np.zeros(len(surface))]))
    np.testing.assert_array_equal(found.distance, np.where(inside, expected.distance, np.inf))
    np.testing.assert_array_equal(found.index, np.where(inside, expected.index, -1))


def test_shared_fields_stay_within_the_memory_and_the_latest_remain(folder: Path) -> None:
    with TiledMap(folder, memory_mb=1.0) as tiles:
        for place in PLACES:
            tiles.shared_field(place, place)
            assert 0 < tiles.fields.nbytes <= 1e6
        tiles.shared_field(PLACES[-1], PLACES[-1])
        assert tiles.fields.builds == len(PLACES)
        tiles.shared_field(PLACES[0], PLACES[0])
        assert tiles.fields.builds == len(PLACES) + 1
        assert tiles.nbytes <= 2e6


def test_a_field_larger_than_the_memory_answers_and_displaces_no_other(folder: Path) -> None:
    with TiledMap(folder) as tiles:
        small, large = tiles.field((4.0, 4.0, 0.0), (4.1, 4.1, 0.1)), tiles.field((4.0, 4.0, 0.0), (6.0, 6.0, 1.0))
    assert small.nbytes < large.nbytes
    cache = FieldCache(small.nbytes)
    assert cache.get(key(0), lambda: small) is small
    assert cache.get(key(1), lambda: large) is large
    assert cache.nbytes == small.nbytes


def test_concurrent_requests_for_one_place_build_one_field(folder: Path) -> None:
    begun, release = threading.Event(), threading.Event()
    with TiledMap(folder) as tiles, ThreadPoolExecutor(4) as pool:
        cache = FieldCache(1e7)

        def build() -> TiledField:
            begun.set()
            assert release.wait(10)
            return tiles.field((4.0, 4.0, 0.0), (4.1, 4.1, 0.1))

        first = pool.submit(cache.get, key(0), build)
        assert begun.wait(10)
        others = [pool.submit(cache.get, key(0), build) for _ in range(3)]
        release.set()
        assert {id(done.result(10)) for done in (first, *others)} == {id(first.result())}
    assert cache.builds == 1


def test_an_error_reaches_its_request_and_the_next_one_builds_again(folder: Path) -> None:
    cache = FieldCache(1e7)

    def fail() -> TiledField:
        raise FormatError("is damaged.", file=folder, hint="restore it")

    with pytest.raises(FormatError, match="is damaged"):
        cache.get(key(0), fail)
    with TiledMap(folder) as tiles:
        cache.get(key(0), lambda: tiles.field((4.0, 4.0, 0.0), (4.1, 4.1, 0.1)))
    assert (cache.builds, cache.nbytes > 0) == (2, True)

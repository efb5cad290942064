"""Damaged and hostile tiled maps are refused with their file and field."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.errors import FormatError
from splatbot.tiles import TiledMap, write_tiles
from tests.unit.tiles.maps import building

Body = dict[str, Any]


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    write_tiles(building(1000), tmp_path, tile_gaussians=100)
    return tmp_path


def rewrite(folder: Path, change: Callable[[Body], Any]) -> None:
    """Change the index, and write it with the digest that belongs to it."""
    file = folder / "tiles.json"
    body = json.loads(file.read_text())
    del body["sha256"]
    change(body)
    text = json.dumps(body, sort_keys=True, separators=(",", ":"))
    file.write_text(json.dumps(body | {"sha256": hashlib.sha256(text.encode()).hexdigest()}))


def test_an_index_that_a_test_writes_again_is_read(folder: Path) -> None:
    rewrite(folder, lambda body: None)
    TiledMap(folder).close()


def set_in(tile: int, name: str, value: object) -> Callable[[Body], Any]:
    return lambda body: body["tiles"][tile].update({name: value})


HOSTILE: dict[str, tuple[Callable[[Body], Any], str]] = {
    "another format": (lambda body: body.update(format="splatbot tiles 2"), "format"),
    "a child of two parents": (set_in(-1, "children", [0, 1]), "children"),
    "its own child": (set_in(2, "children", [2]), "children"),
    "a later child": (set_in(0, "children", [1]), "children"),
    "a negative child": (set_in(2, "children", [-1, 0]), "children"),
    "no parent": (set_in(-1, "children", []), "tiles"),
    "more Gaussians": (lambda body: body.update(gaussians=1001), "gaussians"),
    "Gaussians without end": (set_in(0, "count", 10**12), "count"),
    "a tile of none": (set_in(0, "count", 0), "count"),
    "NaN in a box": (set_in(0, "low", [float("nan"), 0, 0]), "low"),
    "infinity in a box": (set_in(0, "high", [0, float("inf"), 0]), "high"),
    "a box inside out": (set_in(0, "low", [99, 99, 99]), "low"),
    "a box of two numbers": (set_in(0, "low", [0, 0]), "low"),
    "a negative scale": (set_in(0, "scale", -1), "scale"),
    "a text for a scale": (set_in(0, "scale", "wide"), "scale"),
    "an inexact leaf": (set_in(0, "error", 0.5), "error"),
    "a short digest": (set_in(0, "sha256", "ab"), "sha256"),
    "an unknown field": (lambda body: body.update(code="x"), "code"),
    "a missing field": (lambda body: body.pop("sh_degree"), "sh_degree"),
    "degree 5": (lambda body: body.update(sh_degree=5), "sh_degree"),
}


@pytest.mark.parametrize("name", HOSTILE)
def test_a_hostile_index_is_refused_with_file_and_field(folder: Path, name: str) -> None:
    change, field = HOSTILE[name]
    rewrite(folder, change)
    with pytest.raises(FormatError) as caught:
        TiledMap(folder)
    assert caught.value.file == str(folder / "tiles.json")
    assert field in (caught.value.field or "")
    assert caught.value.hint


def test_each_altered_byte_of_the_index_is_noticed_or_without_effect(folder: Path) -> None:
    file = folder / "tiles.json"
    sound = file.read_bytes()
    rng = np.random.default_rng(0)
    refused = 0
    for place in rng.integers(0, len(sound), 200):
        damaged = bytearray(sound)
        damaged[place] ^= 1 << int(rng.integers(0, 8))
        file.write_bytes(damaged)
        try:
            tiles = TiledMap(folder)
        except FormatError:
            refused += 1
        else:
            tiles.close()
            assert json.loads(damaged) == json.loads(sound)  # white space
    assert refused > 100


@pytest.mark.parametrize("text", [b"", b"[]", b"7", b"{", b"\xff\xfe", b"[" * 100_000])
def test_an_index_that_is_no_object_is_refused(folder: Path, text: bytes) -> None:
    (folder / "tiles.json").write_bytes(text)
    with pytest.raises(FormatError, match=r"tiles\.json"):
        TiledMap(folder)


def test_an_index_of_more_than_64_mib_is_not_read(folder: Path) -> None:
    with (folder / "tiles.json").open("r+b") as file:
        file.truncate(64 * 2**20 + 1)  # a hole in the file
    with pytest.raises(FormatError, match="bytes"):
        TiledMap(folder)


def test_missing_and_truncated_data_is_refused(folder: Path) -> None:
    data = folder / "tiles.bin"
    sound = data.read_bytes()
    data.write_bytes(sound[:-1])
    with pytest.raises(FormatError, match=r"tiles\.bin"):
        TiledMap(folder)
    data.unlink()
    with pytest.raises(FormatError, match=r"tiles\.bin"):
        TiledMap(folder)


def test_a_folder_without_an_index_is_refused(tmp_path: Path) -> None:
    with pytest.raises(FormatError, match="splatbot tile"):
        TiledMap(tmp_path)


def test_a_damaged_tile_is_refused_when_it_is_read_and_others_are_not(folder: Path) -> None:
    data = bytearray((folder / "tiles.bin").read_bytes())
    data[0] ^= 1
    (folder / "tiles.bin").write_bytes(data)
    with TiledMap(folder) as tiles:
        with pytest.raises(FormatError, match="tile 0"):
            tiles.near([-99, -99, -99], [99, 99, 99])
        assert len(tiles.overview()) > 0


def test_the_checksum_of_an_index_is_checked_before_its_fields(folder: Path) -> None:
    file = folder / "tiles.json"
    file.write_text(json.dumps(json.loads(file.read_text()) | {"tiles": [{}] * 1000}))
    with pytest.raises(FormatError) as caught:
        TiledMap(folder)
    assert caught.value.field == "sha256"


def test_an_index_of_more_than_100_000_tiles_is_refused(folder: Path) -> None:
    rewrite(folder, lambda body: body.update(tiles=[dict(body["tiles"][0], low=[0] * 3, high=[0] * 3)] * 100_001))
    with pytest.raises(FormatError, match="100000") as caught:
        TiledMap(folder)
    assert caught.value.field == "tiles"


@pytest.mark.parametrize("name", ["tiles.json", "tiles.bin"])
def test_a_pipe_is_refused_without_waiting_for_its_writer(folder: Path, name: str) -> None:
    (folder / name).unlink()
    os.mkfifo(folder / name)
    with pytest.raises(FormatError, match="is no file"):
        TiledMap(folder)


# Bytes of a Gaussian of degree 0 before the arrays: means 12, quaternions 16, scales 12, ..., rows 4 at the end.
LIES: dict[str, tuple[int, str, float, str]] = {
    "no number for a mean": (0, "<f4", np.nan, "finite"),
    "no number for a scale": (28, "<f4", np.nan, "finite"),
    "a mean out of the box": (0, "<f4", 50.0, "box"),
    "a scale above that of the tile": (28, "<f4", 1.0, "scale"),
    "a row beyond the map": (72, "<i4", 1000, "rows"),
    "a negative row": (72, "<i4", -1, "rows"),
}


@pytest.mark.parametrize("name", LIES)
def test_a_tile_that_leaves_its_bounds_is_never_free_space(folder: Path, name: str) -> None:
    before, kind, value, word = LIES[name]
    data = bytearray((folder / "tiles.bin").read_bytes())
    count = json.loads((folder / "tiles.json").read_text())["tiles"][0]["count"]
    place = count * before
    data[place : place + 4] = np.array(value, kind).tobytes()
    (folder / "tiles.bin").write_bytes(data)
    rewrite(folder, set_in(0, "sha256", hashlib.sha256(data[: count * 76]).hexdigest()))
    with TiledMap(folder) as tiles, pytest.raises(FormatError, match=word) as caught:
        tiles.field([-99, -99, -99], [99, 99, 99])
    assert (caught.value.file, caught.value.field) == (str(folder / "tiles.bin"), "tile 0")

"""`splatbot tile`, and the commands that take its folder."""

from __future__ import annotations

import re
import subprocess
import sys
from pathlib import Path

import cv2
import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.formats.ply import save_ply
from tests.unit.cli.conftest import RunCommand, assert_fix_named, assert_refused
from tests.unit.tiles.maps import building


@pytest.fixture
def source(work_folder: Path) -> Path:
    """A map file of 2,000 Gaussians."""
    save_ply(building(2000), work_folder / "map.ply", bookkeeping=True)
    return work_folder / "map.ply"


@pytest.fixture
def tiled(run: RunCommand, source: Path) -> Path:
    """The tiled map of the file."""
    answer = run("tile", source, "--out", "tiles", "--tile-gaussians", 200)
    assert answer.code == 0, answer.err
    return source.with_name("tiles")


def image(path: str) -> NDArray[np.uint8]:
    return np.asarray(cv2.imread(path), dtype=np.uint8)


def test_the_folder_is_described_by_levels(run: RunCommand, tiled: Path) -> None:
    answer = run("info", tiled)
    assert answer.code == 0, answer.err
    assert re.search(r"Gaussians +2,000\n", answer.out)
    assert re.search(r"level 0 .* 1 tile, cells of [\d.]+ c?m$", answer.out, re.MULTILINE)
    assert re.search(r"level 2 .* \d tiles, cells of [\d.]+ c?m to [\d.]+ c?m$", answer.out, re.MULTILINE)
    assert len(re.findall("exact", answer.out)) == 1
    assert "map.ply" in answer.out


def test_an_exact_view_of_the_tiles_is_the_view_of_the_map(run: RunCommand, source: Path, tiled: Path) -> None:
    words = ("--pose", 2, 1, 1.5, 0.7, -0.7, 0, 0, "--size", "96x64")
    assert run("render", source, *words, "--out", "whole.png").code == 0
    answer = run("render", tiled, *words, "--out", "tiles.png", "--pixel-error", 0)
    assert answer.code == 0, answer.err
    assert image("whole.png").any()
    assert np.array_equal(image("whole.png"), image("tiles.png"))


def test_a_view_without_a_pose_shows_most_of_the_map(run: RunCommand, tiled: Path) -> None:
    answer = run("render", tiled, "--mode", "alpha", "--size", "96x64")
    assert answer.code == 0, answer.err
    assert np.mean(image("tiles-alpha.png") > 0) > 0.1


def test_a_view_that_memory_cannot_refine_is_drawn_with_a_warning(run: RunCommand, tiled: Path) -> None:
    words = ("--pose", 2, 1, 1.5, 0.7, -0.7, 0, 0, "--size", "640x480")
    answer = run("render", tiled, *words, "--memory-mb", 0.03)
    assert answer.code == 0, answer.err
    assert "warning: the memory allows a pixel error of" in answer.err


def test_a_sweep_prints_views_and_queries(run: RunCommand, source: Path) -> None:
    answer = run("tile", source, "--out", "tiles", "--tile-gaussians", 200, "--sweep")
    assert answer.code == 0, answer.err
    assert "0 px" in answer.out
    assert "+0.00 dB" in answer.out
    assert re.search(r"verdicts unlike the whole map's +0\n", answer.out)


def test_an_existing_tiled_map_is_replaced_only_with_overwrite(run: RunCommand, source: Path, tiled: Path) -> None:
    assert_fix_named(run("tile", source, "--out", tiled), "--overwrite")
    assert run("tile", source, "--out", tiled, "--overwrite").code == 0
    assert sorted(path.name for path in tiled.iterdir()) == ["tiles.bin", "tiles.json"]


@pytest.mark.parametrize("name", ["map.ply", "metrics.json", "rgb.txt", "metadata.yaml"])
def test_the_folder_of_a_run_or_a_log_is_not_written_to(run: RunCommand, source: Path, name: str) -> None:
    folder = source.with_name("taken")
    folder.mkdir()
    (folder / name).write_text("mine")
    assert_fix_named(run("tile", source, "--out", folder, "--overwrite"), "--out")
    assert [path.name for path in folder.iterdir()] == [name]


def test_serve_names_the_setting_of_a_memory_that_holds_no_tile(
    run: RunCommand, tiled: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATBOT_TILES_MB", "0.001")
    assert_fix_named(run("serve", "--map", tiled), "SPLATBOT_TILES_MB")


def test_options_that_do_not_fit_are_refused(run: RunCommand, source: Path, tiled: Path) -> None:
    assert_fix_named(run("render", source, "--pixel-error", 1), "--pixel-error")
    assert_fix_named(run("render", source, "--memory-mb", 1), "--memory-mb")
    assert_fix_named(run("render", tiled, "--video", "a.mp4"), "--video")
    assert_fix_named(run("render", tiled, "--index", 1), "--index")
    assert_fix_named(run("render", tiled, "--memory-mb", 0), "memory_mb")
    assert_fix_named(run("info", tiled, "--fit-plane"), "--fit-plane")
    assert_fix_named(run("tile", tiled, "--out", "other"), "tiled map")
    assert_fix_named(run("tile", source, "--out", "other", "--memory-mb", 4), "--sweep")
    assert_fix_named(run("tile", source, "--out", "other", "--tile-gaussians", 1), "--tile-gaussians: is 1")
    assert_fix_named(run("tile", source, "--out", "small", "--sweep", "--memory-mb", 0.001), "--memory-mb: is 0.001 MB")
    assert_fix_named(run("tile", source, "--out", source), "--out")


def test_a_damaged_tile_is_refused(run: RunCommand, tiled: Path) -> None:
    data = bytearray((tiled / "tiles.bin").read_bytes())
    data[-1] ^= 1
    (tiled / "tiles.bin").write_bytes(data)
    assert_refused(run("render", tiled), "tiles.bin")


def test_serve_takes_the_folder(tiled: Path) -> None:
    words = [sys.executable, "-m", "splatbot", "serve", "--map", str(tiled), "--port", "0"]
    with subprocess.Popen(words, stdout=subprocess.PIPE, text=True) as process:
        assert process.stdout is not None
        try:
            url = next(found[1] for line in process.stdout if (found := re.search(r"serving on (\S+)", line)))
            described = httpx.get(f"{url}/v1/maps/default").json()
            points = {"points": [[2.0, 2.0, 0.0], [2.0, 2.0, 0.7]]}
            near = httpx.post(f"{url}/v1/maps/default/distance", json=points).json()
        finally:
            process.terminate()
    assert (described["gaussians"], described["source"]) == (2000, "tiles")
    assert near["distance_m"][0] < 0.5 < near["distance_m"][1]


@pytest.mark.parametrize(
    ("words", "mistake"),
    [
        (["--tile-gaussians", 3], "--tile-gaussians: is 3. Fix: give 64 to"),
        (["--sweep", "--memory-mb", 0], "--memory-mb: is 0. Fix: give megabytes, above 0"),
        (["--sweep", "--memory-mb", "nan"], "--memory-mb: is nan"),
    ],
)
def test_a_wrong_number_is_named_with_its_flag_before_anything_is_written(
    run: RunCommand, source: Path, words: list[object], mistake: str
) -> None:
    assert_fix_named(run("tile", source, "--out", "tiles", *words), mistake)
    assert not source.with_name("tiles").exists()

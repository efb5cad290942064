"""`splatbot view`: how surfels are drawn; of a tiled map, refused options and the page of a real process."""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from splatbot.formats.ply import save_ply
from splatbot.gaussians.surfels import as_surfels
from splatbot.tiles import write_tiles
from tests.unit.cli.conftest import RunCommand, assert_fix_named
from tests.unit.services.viewer.viser_client import ViserClient
from tests.unit.tiles.maps import building


@pytest.fixture
def tiled(work_folder: Path) -> Path:
    """A tiled map of 2,000 Gaussians."""
    write_tiles(building(2000), work_folder / "tiles", tile_gaussians=200)
    return work_folder / "tiles"


def test_one_page_of_a_tiled_map_is_refused_and_so_are_its_options_for_other_maps(run: RunCommand, tiled: Path) -> None:
    assert_fix_named(run("view", tiled, "--html", "page.html"), "--html: needs a whole map")
    save_ply(building(50), tiled.with_name("map.ply"), bookkeeping=True)
    for flag in ("--pixel-error", "--memory-mb"):
        assert_fix_named(run("view", tiled.with_name("map.ply"), flag, 2), f"{flag}: is for a tiled map")


@pytest.mark.parametrize(
    ("words", "mistake"),
    [(("--pixel-error", -1), "pixel_error: is -1"), (("--memory-mb", 0.001), "memory_mb: is 0.001")],
)
def test_a_value_that_cannot_be_kept_is_refused(
    run: RunCommand, tiled: Path, words: tuple[object, ...], mistake: str
) -> None:
    assert_fix_named(run("view", tiled, "--port", 0, *words), mistake)


def test_a_map_of_surfels_says_that_a_browser_draws_thin_gaussians_and_another_map_does_not(
    run: RunCommand, work_folder: Path
) -> None:
    maps = {"surfels.ply": as_surfels(building(50)), "map.ply": building(50)}
    for name, model in maps.items():
        save_ply(model, work_folder / name, bookkeeping=True)
    printed = {name: run("view", work_folder / name, "--html", work_folder / "page.html").out for name in maps}
    assert "surfels.ply holds surfels: browsers draw thin Gaussians" in printed["surfels.ply"]
    assert "holds surfels" not in printed["map.ply"]


@pytest.mark.long
def test_the_address_opens_the_page_with_the_given_error_and_memory(tiled: Path) -> None:
    words = ["view", str(tiled), "--port", "0", "--pixel-error", "0", "--memory-mb", "0.05"]
    process = subprocess.Popen([sys.executable, "-m", "splatbot", *words], stdout=subprocess.PIPE, text=True)
    try:
        assert process.stdout is not None
        line = process.stdout.readline()
        found = re.search(r"127\.0\.0\.1:(\d+)/\?key=KEY .* shows (.*); Ctrl-C ends", line)
        assert found is not None, line
        assert found[2] == str(tiled)
        with ViserClient(int(found[1])) as client:
            client.look(np.array([-8.0, 6.0, 25.0]), (0.0, 1.0, 0.0, 0.0))
            client.read(lambda: "0 px are requested" in client.text)
            assert "The limit of 657 Gaussians" in client.text  # 0.05 MB at 76 bytes a Gaussian
            assert 0 < client.most <= 657
    finally:
        process.send_signal(signal.SIGTERM)
        process.wait(30)

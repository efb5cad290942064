"""The viewer of a tiled map as Chromium draws it, compared with the viewer of the whole map."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.evaluation.image import psnr
from splatbot.gaussians import Snapshot
from splatbot.service_key import key_file, read_key
from splatbot.services.access import Access
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from splatbot.services.viewer.tiled_viewer import TiledViewer
from splatbot.services.viewer.viewer import Viewer
from splatbot.tiles import TiledMap, write_tiles
from tests.browser.chromium import Chromium
from tests.unit.tiles.maps import building

pytestmark = [pytest.mark.long, pytest.mark.alone]

WIDTH, HEIGHT, FOV = 1000, 420, 50.0
FREE = slice(320, 660)  # columns between a notice of Chromium and the panel
EYE, TARGET = np.array([1.4, 1.4, 1.5]), np.array([0.0, 0.7, 1.2])  # 1.5 m from a wall
LIMIT = 20_000


@pytest.fixture
def browser(tmp_path: Path) -> Iterator[Chromium]:
    with Chromium(tmp_path / "profile", width=WIDTH, height=HEIGHT) as found:
        yield found


def _steady(browser: Chromium, viewer: Viewer | TiledViewer, text: str) -> NDArray[np.uint8]:
    """Open a viewer at the view of the wall, and capture its picture once a text is there and the picture rests."""
    viewer._scene._up = np.array([0.0, 0.0, 1.0])
    viewer.server.scene.set_up_direction("+z")
    viewer._scene.look(EYE, TARGET, fov_deg=FOV)
    browser.open(f"http://127.0.0.1:{viewer.port}/?key={read_key(key_file())}")
    last = np.zeros(0, np.uint8)
    for _ in range(120):
        time.sleep(0.5)
        image: NDArray[np.uint8] = browser.screenshot()[:, FREE]
        rests = image.shape == last.shape and np.array_equal(image, last) and image.std() > 10
        if rests and text in browser.evaluate("document.body.innerText"):
            return image
        last = image
    raise AssertionError(browser.evaluate("document.body.innerText"))


def test_near_a_wall_the_picture_of_the_tiles_is_that_of_the_whole_map(browser: Chromium, tmp_path: Path) -> None:
    model = building(100_000, size=0.04)
    write_tiles(model, tmp_path / "tiles", tile_gaussians=1000)
    store = MapStore()
    store.add("house", source="a", state="static", snapshot=Snapshot(model, 1))
    whole_viewer = Viewer(store, Access(ServiceSettings()), port=0)
    whole_viewer.start()
    try:
        while not whole_viewer._scene._drawn:  # it then looks at all
            time.sleep(0.05)
        whole = _steady(browser, whole_viewer, "house")
    finally:
        whole_viewer.stop()
    tiles = TiledMap(tmp_path / "tiles", memory_mb=LIMIT * 76 / 1e6)
    viewer = TiledViewer(tiles, Access(ServiceSettings()), port=0)
    viewer.start()
    try:
        image = _steady(browser, viewer, "pixel error is")
        found = re.search(r"([\d,]+) of 100,000 Gaussians", browser.evaluate("document.body.innerText"))
        assert found is not None
        score = psnr(image, whole)
        print(f"{found[1]} of {len(model):,} Gaussians, PSNR {score:.1f} dB")
        assert int(found[1].replace(",", "")) <= LIMIT
        assert score > 45.0
    finally:
        viewer.stop()

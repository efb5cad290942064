"""The viewer of a tiled map, with clients of its WebSocket."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import replace
from functools import partial
from pathlib import Path

import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import FormatError, InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import look_at, rotation_to_quat
from splatbot.robots.store import load_robot
from splatbot.services.access import Access
from splatbot.services.settings import ServiceSettings
from splatbot.services.viewer import tile_browser
from splatbot.services.viewer.scene import clearance_colors
from splatbot.services.viewer.tile_browser import TileBrowserConstants
from splatbot.services.viewer.tiled_viewer import TiledViewer
from splatbot.tiles import TiledMap, write_tiles
from splatbot.workspace import Workspace
from tests.unit.services.viewer.viser_client import FOV, HEIGHT, WIDTH, Array, ViserClient
from tests.unit.tiles.maps import SIDE, building
from tests.waiting import until

N, TILE = 4000, 200
DOWN = np.array([0.0, 0.0, -1.0])
BYTES = 76  # of a Gaussian of degree 0 in the file
EXACT_MB = N * BYTES / 1e6
INSIDE = np.array([2.0, 2.0, 1.5])
EAST, WEST, NORTH, NORTH_EAST = (np.array([x, y, 1.5]) for x, y in ((20, 2), (-20, 2), (2, 20), (20, 18)))
ABOVE, FLOOR = np.array([-8.0, 6.0, 25.0]), np.array([6.0, 6.0, 1.0])
MODEL = building(N)
MEANS = MODEL.means.double().numpy()

Open = Callable[..., TiledViewer]


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The tiled map of a simulated building."""
    place = tmp_path_factory.mktemp("maps") / "tiles"
    write_tiles(MODEL, place, tile_gaussians=TILE)
    return place


@pytest.fixture
def open_viewer(folder: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Open]:
    """Opens viewers of the map with some memory in Gaussians, which follow a camera sooner than usual."""
    monkeypatch.setattr(tile_browser, "CONSTANTS", TileBrowserConstants(rest=0.1, period=0.1))
    opened: list[TiledViewer] = []

    def call(gaussians: int = N, place: Path = folder, **more: object) -> TiledViewer:
        tiles = TiledMap(place, memory_mb=(gaussians + 0.5) * BYTES / 1e6)
        viewer = TiledViewer(tiles, Access(ServiceSettings()), port=0, **more)  # type: ignore[arg-type]
        opened.append(viewer)
        viewer.start()
        return viewer

    yield call
    for viewer in opened:
        viewer.stop()


def pose(eye: Array, target: Array) -> tuple[Array, tuple[float, float, float, float]]:
    T = look_at(eye, target)
    w, x, y, z = rotation_to_quat(T[:3, :3]).tolist()
    return eye, (w, x, y, z)


def in_camera(eye: Array, target: Array, points: NDArray[np.floating]) -> Array:
    """Return points in the axes of a camera."""
    return np.asarray((points - eye) @ look_at(eye, target)[:3, :3])


def seen(eye: Array, target: Array) -> NDArray[np.bool_]:
    """Return whether the centre of each Gaussian of the map is in the picture."""
    x, y, z = in_camera(eye, target, MEANS).T
    half = np.tan(FOV / 2)
    return (z > 0.05) & (np.abs(y) < half * z) & (np.abs(x) < half * WIDTH / HEIGHT * z)


def rows(points: NDArray[np.float32]) -> set[tuple[float, ...]]:
    return set(map(tuple, points.tolist()))


def settled(client: ViserClient) -> bool:
    return "pixel error is" in client.text


def has_view(client: ViserClient, target: Array) -> bool:
    """Return whether a browser has all Gaussians of the map in its view from the inside."""
    return rows(MODEL.means.numpy()[seen(INSIDE, target)]) <= rows(client.centers)


def test_the_coarsest_tile_comes_first_and_the_tiles_of_the_view_when_the_camera_rests(
    open_viewer: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    viewer, at_rest = open_viewer(), tile_browser.CONSTANTS
    monkeypatch.setattr(tile_browser, "CONSTANTS", replace(at_rest, rest=3600.0))  # the first tile may come late
    with ViserClient(viewer.port) as client:
        client.look(*pose(INSIDE, EAST))
        client.read(lambda: len(client.splats) > 0)
        assert len(client.splats) == 1
        assert len(client.centers) <= TILE
        assert np.ptp(client.centers, axis=0)[:2].min() > 0.8 * SIDE
        monkeypatch.setattr(tile_browser, "CONSTANTS", at_rest)
        client.look(*pose(INSIDE, EAST))
        client.read(lambda: settled(client))
        assert len(client.splats) > 3
        assert f"{len(client.centers):,} of {N:,} Gaussians" in client.text
        assert "merged Gaussians have no uncertainty" in client.text


def test_a_view_at_error_0_has_all_gaussians_in_view_and_drops_those_behind(open_viewer: Open) -> None:
    with ViserClient(open_viewer(pixel_error=0.0).port) as client:
        for target in (EAST, WEST):
            client.look(*pose(INSIDE, target))
            client.read(partial(has_view, client, target))
            client.drain(0.3)
            assert rows(client.centers) <= rows(MODEL.means.numpy())
            assert in_camera(INSIDE, target, client.centers)[:, 2].min() > -4.0
            assert in_camera(INSIDE, target, MEANS)[:, 2].min() < (-4.0 if target is WEST else -1.5)
        assert "pixel error is 0.00 px, and 0 px are requested" in client.text


def test_tiles_in_both_views_stay_and_a_camera_at_rest_receives_nothing(open_viewer: Open) -> None:
    with ViserClient(open_viewer(pixel_error=0.0).port) as client:
        client.look(*pose(INSIDE, EAST))
        client.read(lambda: settled(client))
        before = set(client.splats)
        count = len(client.sent)
        client.look(*pose(INSIDE, EAST))
        client.drain(0.5)
        assert len(client.sent) == count
        client.look(*pose(INSIDE, NORTH_EAST))
        client.read(lambda: len(client.sent) > count)
        client.drain(0.3)
        kept = before & set(client.splats)
        assert len(kept) >= 3
        assert before - kept
        assert set(client.sent[count:]) == set(client.splats) - kept


def test_a_browser_never_has_more_gaussians_than_the_memory(open_viewer: Open) -> None:
    limit = 900
    with ViserClient(open_viewer(limit, pixel_error=0.0).port) as client:
        for target in (EAST, NORTH, WEST, NORTH_EAST):
            client.look(*pose(INSIDE, target))
            client.drain(0.4)
        client.look(*pose(ABOVE, FLOOR))
        client.read(lambda: "allows no less" in client.text)
        assert 0.5 * limit < client.most <= limit
        assert f"The limit of {limit} Gaussians a browser allows no less" in client.text
        assert len(set(client.sent)) == len(client.sent)  # a name in use twice would hide a tile on its way


def test_two_browsers_have_the_tiles_of_their_own_cameras(open_viewer: Open) -> None:
    viewer = open_viewer(pixel_error=0.0)
    with ViserClient(viewer.port) as east, ViserClient(viewer.port) as west:
        east.look(*pose(INSIDE, EAST))
        west.look(*pose(INSIDE, WEST))
        for client, target in ((east, EAST), (west, WEST)):
            client.read(partial(settled, client))
            assert has_view(client, target)
        assert len(rows(east.centers) - rows(west.centers)) > 500


def test_of_a_stream_of_cameras_the_last_is_served_and_few_before_it(
    open_viewer: Open, monkeypatch: pytest.MonkeyPatch
) -> None:
    # A busy machine sends the stream with pauses, in which the camera must not seem to rest.
    monkeypatch.setattr(tile_browser, "CONSTANTS", TileBrowserConstants(rest=0.5, period=0.1))
    with ViserClient(open_viewer(pixel_error=0.0).port) as client:
        client.look(*pose(INSIDE, EAST))
        client.read(lambda: settled(client))
        count = len(client.sent)
        for _ in range(200):
            client.look(*pose(INSIDE, NORTH))
            client.look(*pose(INSIDE, WEST))
        client.read(lambda: has_view(client, WEST))
        client.drain(0.4)
        assert len(client.sent) - count < 5 * len(client.splats)  # of 400 cameras
        assert in_camera(INSIDE, WEST, client.centers)[:, 2].min() > -4.0


def test_a_browser_that_leaves_is_released_and_no_more_than_8_are_served(open_viewer: Open) -> None:
    viewer = open_viewer()
    with ExitStack() as open_:
        clients = [open_.enter_context(ViserClient(viewer.port)) for _ in range(8)]
        for client in clients:
            client.look(*pose(INSIDE, EAST))
        for client in clients:
            client.read(partial(settled, client))
        assert httpx.get(f"http://127.0.0.1:{viewer.port}/").status_code == 503
        drawn = [browser._drawn for browser in viewer._browsers.values()]
        assert all(drawn)
    until(lambda: not viewer._browsers and not any(drawn))
    with ViserClient(viewer.port) as client:
        client.look(*pose(INSIDE, WEST))
        client.read(lambda: settled(client))


@pytest.mark.parametrize(
    ("position", "wxyz", "fov"),
    [
        ([np.nan, 0.0, 0.0], (1.0, 0.0, 0.0, 0.0), FOV),
        ([0.0, 0.0, 0.0], (0.0, 0.0, 0.0, 0.0), FOV),
        ([0.0, 0.0], (1.0, 0.0, 0.0, 0.0), FOV),
        ([0.0, 0.0, 0.0], (1.0, 0.0, 0.0, 0.0), -1.0),
        ([0.0, 0.0, 0.0], (1.0, 0.0, 0.0, 0.0), np.nan),
    ],
)
def test_a_camera_that_is_none_is_named_and_the_next_one_is_served(
    open_viewer: Open, position: list[float], wxyz: tuple[float, float, float, float], fov: float
) -> None:
    with ViserClient(open_viewer().port) as client:
        client.look(np.array(position), wxyz, fov)
        client.read(lambda: "cannot be shown" in client.text)
        client.look(*pose(INSIDE, EAST))
        client.read(lambda: settled(client))


def test_the_crop_the_colours_and_the_measure_work_on_the_tiles_that_are_loaded(open_viewer: Open) -> None:
    with ViserClient(open_viewer(pixel_error=0.0).port) as client:
        client.look(*pose(ABOVE, FLOOR))
        client.read(lambda: settled(client))
        assert len(client.centers) == N
        own = client.colors
        client.set("colours", "depth")  # along the world's z, from its origin
        client.read(lambda: len(client.centers) == N and not np.array_equal(client.colors, own))
        client.drain(0.3)
        rgb, z = client.colors.astype(int), client.centers[:, 2]
        near, far = z < np.percentile(z, 5), z > np.percentile(z, 95)
        assert (rgb[near, 0] > rgb[near, 2]).all()
        assert (rgb[far, 2] > rgb[far, 0]).all()
        client.set("measure", True)
        opaque = MEANS[(MODEL.opacities.numpy() > 0.8) & (MEANS[:, 2] > 0.95 * MEANS[:, 2].max())]  # the ceiling
        ends = opaque[opaque[:, 0].argmin()], opaque[opaque[:, 0].argmax()]
        client.click(ends[0] - 9.0 * DOWN, DOWN)
        client.read(lambda: "/measure/0" in client.nodes)
        client.click(ends[1] - 9.0 * DOWN, DOWN)
        client.read(lambda: " mm" in client.text)
        (distance,) = re.findall(r"^(\d+) mm$", client.text, re.MULTILINE)
        assert float(distance) == pytest.approx(1e3 * np.linalg.norm(ends[0] - ends[1]), abs=20.0)
        client.set("crop, m", 2.0)
        client.read(lambda: 0 < len(client.centers) < N)
        client.drain(0.3)
        middle = np.median(MEANS, axis=0)
        assert np.linalg.norm(client.centers - middle, axis=1).max() < 2.0 + 0.5


def test_a_scene_shows_its_robot_coloured_as_by_the_whole_map(open_viewer: Open) -> None:
    robot, base = load_robot("panda"), np.eye(4)
    q = np.asarray(robot.home)
    hand = RobotSpheres(robot, T_world_base=base).centers(q[None])[0][-1]
    base[:3, 3] = MEANS[np.linalg.norm(MEANS - INSIDE, axis=1).argmin()] - hand
    viewer = open_viewer(workspace=Workspace(T_world_base=base))
    with ViserClient(viewer.port) as client:
        client.look(*pose(INSIDE, EAST))
        client.read(lambda: settled(client))
        assert any(name.startswith("/robot/now/meshes") for name in client.nodes)
        assert "robot" in {props.get("label") for props in client.gui.values()}
    arm = RobotSpheres(robot, T_world_base=base)
    expected = clearance_colors(GaussianCollisionField(MODEL), arm.centers(q[None])[0], arm.spheres.radii)
    assert len(np.unique(expected, axis=0)) > 3
    np.testing.assert_array_equal(viewer._scene._balls["now"].batched_colors, expected)


def test_a_robot_whose_tiles_exceed_the_memory_is_grey_with_the_reason(open_viewer: Open) -> None:
    base = np.eye(4)
    base[:3, 3] = np.median(MEANS, axis=0)  # where tiles meet
    with ViserClient(open_viewer(TILE, workspace=Workspace(T_world_base=base)).port) as client:
        client.look(*pose(INSIDE, EAST))
        client.read(lambda: "spheres are grey" in client.text)


def test_a_damaged_tile_is_named_and_a_damaged_overview_is_refused(tmp_path: Path, open_viewer: Open) -> None:
    place = tmp_path / "tiles"
    write_tiles(MODEL, place, tile_gaussians=TILE)
    data = bytearray((place / "tiles.bin").read_bytes())
    data[0] ^= 1
    (place / "tiles.bin").write_bytes(data)
    with ViserClient(open_viewer(place=place, pixel_error=0.0).port) as client:
        client.look(*pose(ABOVE, FLOOR))
        client.read(lambda: "cannot be shown" in client.text)
        assert "tile 0" in client.text
        assert len(client.splats) == 1  # the coarsest stays
    data[-1] ^= 1
    (place / "tiles.bin").write_bytes(data)
    with pytest.raises(FormatError, match="damaged"):
        open_viewer(place=place)


def test_an_empty_map_is_shown_as_one(tmp_path: Path, open_viewer: Open) -> None:
    write_tiles(GaussianModel.empty(), tmp_path / "tiles")
    with ViserClient(open_viewer(place=tmp_path / "tiles").port) as client:
        client.look(*pose(INSIDE, EAST))
        client.read(lambda: settled(client))
        assert "0 of 0 Gaussians** are loaded, in 0 tiles" in client.text
        client.set("measure", True)
        client.click(INSIDE, DOWN)
        client.set("crop, m", 1.0)
        client.drain(0.4)
        assert "cannot be shown" not in client.text
        assert not client.sent


@pytest.mark.parametrize(
    ("label", "value"), [("crop, m", "wide"), ("crop, m", np.nan), ("colours", "pink"), ("colours", 3)]
)
def test_a_control_of_no_meaning_does_not_end_the_view(open_viewer: Open, label: str, value: object) -> None:
    viewer = open_viewer()
    with ViserClient(viewer.port) as client:
        client.look(*pose(INSIDE, EAST))
        client.read(lambda: settled(client))
        client.set(label, value)
        client.drain(0.4)
    with ViserClient(viewer.port) as client:
        client.look(*pose(INSIDE, EAST))
        client.read(lambda: settled(client))


@pytest.mark.parametrize("error", [-1.0, np.inf, np.nan])
def test_an_error_that_is_none_is_refused(open_viewer: Open, error: float) -> None:
    with pytest.raises(InputError, match="pixel_error"):
        open_viewer(pixel_error=error)

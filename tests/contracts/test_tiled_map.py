"""A tiled map over HTTP: the answers of the whole map where tiles suffice, and a refusal elsewhere."""

from __future__ import annotations

import io
import time
from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path

import httpx
import numpy as np
import pytest

from splatbot.cli.serve import _add_map
from splatbot.cli.tile import tile
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.formats.ply import save_ply
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.robots.panda import panda
from splatbot.services.runtime import Runtime
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from splatbot.tiles import TiledMap, write_tiles
from splatbot.workspace import Workspace
from tests.contracts.conftest import Service, running
from tests.unit.tiles.maps import building

ORIGIN = {"translation": [6.3, 6.1, 0.4], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
POSE = {"translation": [6.0, 5.0, 1.5], "quaternion_wxyz": [0.7, -0.7, 0.0, 0.0]}
SPREAD = [[turn, 1.2, 0.0, -0.5, 0.0, 1.5, 0.0] for turn in (-2.5, -1.2, 0.0, 1.2, 2.5)]  # around the base
CAMERA = {"fx": 90.0, "fy": 90.0, "cx": 47.5, "cy": 31.5, "width": 96, "height": 64}


@pytest.fixture(scope="module")
def model() -> GaussianModel:
    model = building(6000, size=0.05)
    model.observations += 1
    return model


@pytest.fixture(scope="module")
def service(model: GaussianModel, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """The service on one map, once from memory and once from tiles."""
    folder: Path = tmp_path_factory.mktemp("tiles")
    write_tiles(model, folder, tile_gaussians=300)
    store = MapStore()
    store.add("whole", source="map.ply", state="static", snapshot=Snapshot(model, 1))
    with TiledMap(folder) as tiles:
        store.add("tiles", source="tiles", state="static", awaited=False, tiles=tiles)
        with running(ServiceSettings(), store) as it:
            yield it


def both(service: Service, path: str, body: object) -> tuple[httpx.Response, httpx.Response]:
    """Post a request to both maps; neither refuses it."""
    whole, tiles = (service.client.post(f"/v1/maps/{name}/{path}", json=body) for name in ("whole", "tiles"))
    assert whole.status_code == tiles.status_code == 200, tiles.text
    return whole, tiles


def test_collisions_of_an_arm_are_those_of_the_whole_map(service: Service) -> None:
    q = np.random.default_rng(0).uniform(-1.0, 1.0, (40, 7)) + np.array([0, -0.785, 0, -2.356, 0, 1.571, 0.785])
    q[:, 3] = np.clip(q[:, 3], -3.0, -0.1)
    body = {"q": q.tolist(), "base": ORIGIN, "gradient": True}
    whole, tiles = (answer.json() for answer in both(service, "collisions", body))
    assert 0 < sum(whole["in_collision"]) < len(q)
    assert max(whole["clearance"]) < 1.0
    assert tiles == whole


@pytest.mark.parametrize("n_sigma", [1.0, 2.0])
def test_distances_are_those_of_the_whole_map_up_to_their_bounds(service: Service, n_sigma: float) -> None:
    points = np.random.default_rng(1).uniform((6.0, 6.0, 0.0), (7.5, 7.5, 0.6), (300, 3))
    points[:20, 2] = 0.0
    body = {"points": points.tolist(), "n_sigma": n_sigma}
    whole, tiles = (answer.json() for answer in both(service, "distance", body))
    assert any(whole["inside"])
    assert tiles["inside"] == whole["inside"]
    assert tiles["distance_m"] == whole["distance_m"]
    for row, inside in enumerate(whole["inside"]):
        assert tiles["distance_sigma"][row] == (whole["distance_sigma"][row] if inside else None)
        assert tiles["index"][row] == (whole["index"][row] if inside else -1)


def test_one_point_queries_of_one_place_build_one_field_within_the_memory(model: GaussianModel, tmp_path: Path) -> None:
    write_tiles(model, tmp_path, tile_gaussians=300)
    store = MapStore()
    with TiledMap(tmp_path, memory_mb=10.0) as tiles:
        store.add("tiles", source="tiles", state="static", awaited=False, tiles=tiles)
        with running(ServiceSettings(), store) as service:

            def ask(point: list[float]) -> dict[str, object]:
                answer = service.client.post("/v1/maps/tiles/distance", json={"points": [point]})
                assert answer.status_code == 200, answer.text
                return dict(answer.json())

            first = ask([6.1, 6.1, 0.2])
            assert (ask([6.1, 6.1, 0.2]), ask([6.3, 6.2, 0.1])["map_version"]) == (first, 1)
            assert tiles.fields.builds == 1
            for x in np.arange(0.2, 12.0, 1.5):
                assert ask([float(x), 6.1, 0.2]) == ask([float(x), 6.1, 0.2])
                assert tiles.fields.nbytes <= 10e6
    assert tiles.fields.builds == 1 + 8


def test_views_of_near_surfaces_are_those_of_the_whole_map(service: Service) -> None:
    body = {"camera": CAMERA, "mode": "rgb", **POSE}
    whole, tiles = both(service, "render", body)
    assert tiles.content == whole.content
    query = {"views": [{"camera": CAMERA, "pose": POSE}], "modes": ["rgb", "depth"]}
    first, second = (answer.json() for answer in both(service, "views", query))
    assert first == second
    assert first["pixel_error"] == [0.0]


def test_views_state_the_pixel_error_that_memory_allows(model: GaussianModel, tmp_path: Path) -> None:
    write_tiles(model, tmp_path, tile_gaussians=300)
    store = MapStore()
    store.add("whole", source="map.ply", state="static", snapshot=Snapshot(model, 1))
    with TiledMap(tmp_path, memory_mb=0.05) as tiles:
        store.add("tiles", source="tiles", state="static", awaited=False, tiles=tiles)
        with running(ServiceSettings(), store) as service:
            whole, coarse = both(service, "render", {"camera": CAMERA, **POSE})
            views = [answer.json() for answer in both(service, "views", {"views": [{"camera": CAMERA, "pose": POSE}]})]
    assert whole.headers["X-Pixel-Error"] == "0"
    assert float(coarse.headers["X-Pixel-Error"]) > 1.0
    assert views[0]["pixel_error"] == [0.0]
    np.testing.assert_allclose(views[1]["pixel_error"], float(coarse.headers["X-Pixel-Error"]), rtol=1e-3)


def test_a_damaged_coarsest_tile_does_not_break_lists_and_near_views(model: GaussianModel, tmp_path: Path) -> None:
    write_tiles(model, tmp_path, tile_gaussians=300)
    data = bytearray((tmp_path / "tiles.bin").read_bytes())
    data[-1] ^= 1
    (tmp_path / "tiles.bin").write_bytes(data)
    store = MapStore()
    with TiledMap(tmp_path) as tiles:
        store.add("tiles", source="tiles", state="static", awaited=False, tiles=tiles)
        with running(ServiceSettings(), store) as service:
            listed = service.client.get("/v1/maps")
            drawn = service.client.post("/v1/maps/tiles/render", json={"camera": CAMERA, **POSE})
            refused = service.client.get("/v1/maps/tiles/render")
    assert listed.json()["maps"][0]["sh_degree"] == 0
    assert drawn.status_code == 200
    assert (refused.status_code, "is damaged" in refused.json()["detail"]) == (422, True)


def test_a_point_that_is_no_number_is_refused_by_its_row(service: Service) -> None:
    points = np.zeros((3, 3))
    points[1, 2] = np.nan
    file = io.BytesIO()
    np.save(file, points)
    headers = {"content-type": "application/x-npy"}
    answer = service.client.post("/v1/maps/tiles/distance", content=file.getvalue(), headers=headers)
    assert answer.status_code == 422
    assert "points: row 1 is not finite" in answer.json()["detail"]


def test_collisions_are_of_the_arm_with_the_joint_offsets_of_the_scene(model: GaussianModel, tmp_path: Path) -> None:
    T = np.eye(4)
    T[:3, 3] = 7.25, 6.1, 0.9  # the hand is near the wall at 8 m
    offsets = np.array([0.0, 0.06, -0.04, 0.08, 0.02, -0.06, 0.0])
    save_ply(model, tmp_path / "map.ply", bookkeeping=True)
    Workspace(T_world_base=T, joint_offsets=offsets, offsets_of="panda").save(tmp_path / "scene.yaml")
    assert tile(tmp_path / "map.ply", out=tmp_path / "tiles", tile_gaussians=300) == 0
    runtime = Runtime(ServiceSettings())
    _add_map(runtime, tmp_path / "tiles")
    q = panda().home
    with running(ServiceSettings(), runtime.store) as service:
        answer = service.client.post("/v1/maps/default/collisions", json={"q": [q.tolist()]})
    field = GaussianCollisionField(GaussianModel.load(tmp_path / "map.ply"))
    arm = RobotSpheres(panda(), T_world_base=T)
    true, reported = (float(arm.clearance(field, at[None]).distance[0]) for at in (q + offsets, q))
    assert abs(true - reported) > 1e-3
    np.testing.assert_allclose(answer.json()["clearance"], [true], atol=1e-9)


def test_a_deleted_map_leaves_no_open_file(model: GaussianModel, tmp_path: Path) -> None:
    write_tiles(model, tmp_path, tile_gaussians=300)
    store = MapStore()
    store.add("tiles", source="tiles", state="static", awaited=False, tiles=TiledMap(tmp_path))
    with running(ServiceSettings(), store) as service:
        assert service.client.get("/v1/maps/tiles/render").status_code == 200
        assert str(tmp_path / "tiles.bin") in open_files()
        assert service.client.delete("/v1/maps/tiles").status_code == 204
        deadline = time.monotonic() + 10.0
        while str(tmp_path / "tiles.bin") in open_files() and time.monotonic() < deadline:
            service.client.get("/v1/maps")
        assert str(tmp_path / "tiles.bin") not in open_files()


def open_files() -> set[str]:
    """Return the paths of the files that this process has open."""
    found = set()
    for descriptor in Path("/proc/self/fd").iterdir():
        with suppress(OSError):
            found.add(str(descriptor.readlink()))
    return found


def test_the_map_is_described_and_drawn_without_a_pose(service: Service) -> None:
    whole, tiles = (service.client.get(f"/v1/maps/{name}").json() for name in ("whole", "tiles"))
    for name in ("gaussians", "sh_degree", "bounds", "map_version", "state"):
        assert tiles[name] == whole[name], name
    assert service.client.get("/v1/maps/tiles/render").headers["content-type"] == "image/png"
    assert service.client.get("/readyz").status_code == 200
    assert "6,000" in service.client.get("/").text


def test_a_request_of_the_whole_map_is_refused_with_a_hint(service: Service) -> None:
    answer = service.client.get("/v1/maps/tiles/splats.ply")
    assert answer.status_code == 422
    assert "tiled" in answer.json()["detail"]
    assert "serve the map" in answer.json()["hint"]
    home = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]
    answer = service.client.post("/v1/maps/tiles/plans", json={"start": home, "goal": home, "base": ORIGIN})
    assert (answer.status_code, "tiled" in answer.json()["detail"]) == (422, True)


def test_too_many_tiles_are_refused_with_field_and_setting(model: GaussianModel, tmp_path: Path) -> None:
    write_tiles(model, tmp_path, tile_gaussians=300)
    store = MapStore()
    with TiledMap(tmp_path, memory_mb=0.05) as tiles:
        store.add("tiles", source="tiles", state="static", awaited=False, tiles=tiles)
        with running(ServiceSettings(), store) as service:
            answer = service.client.post("/v1/maps/tiles/distance", json={"points": [[0, 0, 0], [12, 12, 3]]})
            collisions = service.client.post("/v1/maps/tiles/collisions", json={"q": SPREAD, "base": ORIGIN})
    for refused, field in ((answer, "points"), (collisions, "q")):
        assert refused.status_code == 422
        assert refused.json()["detail"].startswith(f"{field}: needs")
        assert "SPLATBOT_TILES_MB" in refused.json()["hint"]

"""A tiled map over HTTP: the answers of the whole map where tiles suffice, and a refusal elsewhere."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import httpx
import numpy as np
import pytest

from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from splatbot.tiles import TiledMap, write_tiles
from tests.contracts.conftest import Service, running
from tests.unit.tiles.maps import building

ORIGIN = {"translation": [6.3, 6.1, 0.4], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
POSE = {"translation": [6.0, 5.0, 1.5], "quaternion_wxyz": [0.7, -0.7, 0.0, 0.0]}
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


def test_views_of_near_surfaces_are_those_of_the_whole_map(service: Service) -> None:
    body = {"camera": CAMERA, "mode": "rgb", **POSE}
    whole, tiles = both(service, "render", body)
    assert tiles.content == whole.content
    query = {"views": [{"camera": CAMERA, "pose": POSE}], "modes": ["rgb", "depth"]}
    first, second = (answer.json()["views"] for answer in both(service, "views", query))
    assert first == second


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


def test_points_over_too_many_tiles_are_refused(model: GaussianModel, tmp_path: Path) -> None:
    write_tiles(model, tmp_path, tile_gaussians=300)
    store = MapStore()
    with TiledMap(tmp_path, memory_mb=0.1) as tiles:
        store.add("tiles", source="tiles", state="static", awaited=False, tiles=tiles)
        with running(ServiceSettings(), store) as service:
            answer = service.client.post("/v1/maps/tiles/distance", json={"points": [[0, 0, 0], [12, 12, 3]]})
    assert answer.status_code == 422
    assert "memory_mb" in answer.json()["hint"]

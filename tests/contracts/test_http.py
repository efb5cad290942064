"""Promises to HTTP clients, checked with httpx on a real uvicorn server."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import cv2
import httpx
import numpy as np
import pytest
from numpy.typing import NDArray

from splatbot.services.store import MapStore
from tests.contracts.conftest import Service, serving_wall, wall

POINTS = [[0.0, 0.0, 1.0], [0.0, 0.0, 0.5], [0.1, 0.2, 1.0005]]
CAMERA = {"fx": 200, "fy": 200, "cx": 79.5, "cy": 59.5, "width": 160, "height": 120}


@pytest.fixture(scope="module")
def service() -> Iterator[Service]:
    """The service on the map "wall", which its tests do not change."""
    with serving_wall() as it:
        yield it


@pytest.fixture
def own_service() -> Iterator[Service]:
    """The service of one test, which may change its maps."""
    with serving_wall() as it:
        yield it


def _problem(response: httpx.Response, status: int) -> dict[str, Any]:
    assert response.status_code == status, response.text
    assert response.headers["content-type"] == "application/problem+json"
    body: dict[str, Any] = response.json()
    assert body["status"] == status
    assert body["title"]
    assert body["detail"]
    return body


def _image(response: httpx.Response) -> NDArray[np.uint8]:
    assert response.status_code == 200, response.text
    assert response.headers["content-type"] == "image/png"
    decoded = cv2.imdecode(np.frombuffer(response.content, np.uint8), cv2.IMREAD_UNCHANGED)
    assert decoded is not None
    return np.asarray(decoded[..., ::-1] if decoded.ndim == 3 else decoded, dtype=np.uint8)


def test_alive_and_ready(service: Service) -> None:
    assert service.client.get("/healthz").json()["status"] == "ok"
    ready = service.client.get("/readyz")
    assert (ready.status_code, ready.json()["status"]) == (200, "ready")


def test_maps_are_listed_and_described(service: Service) -> None:
    (listed,) = service.client.get("/v1/maps").json()["maps"]
    described = service.client.get("/v1/maps/wall").json()
    assert listed == described
    assert (described["map_version"], described["gaussians"], described["state"]) == (1, 2601, "static")
    np.testing.assert_allclose(described["bounds"]["low"], [-0.5, -0.5, 1.0], atol=1e-6)
    np.testing.assert_allclose(described["bounds"]["high"], [0.5, 0.5, 1.0], atol=1e-6)


def test_distances_are_those_of_the_field_and_name_the_version(service: Service) -> None:
    answer = service.client.post("/v1/maps/wall/distance", json={"points": POINTS, "n_sigma": 2.0}).json()
    expected = service.store.get("wall").field.mahalanobis(np.array(POINTS))
    assert answer["map_version"] == 1
    assert answer["inside"] == [True, False, True]
    np.testing.assert_allclose(answer["distance_sigma"], expected.distance, rtol=1e-6)
    assert answer["index"] == expected.index.tolist()
    assert answer["distance_sigma"][1] == pytest.approx(500.0, rel=1e-3)  # 0.5 m in front of a wall of 1 mm


def test_no_points_are_a_question_with_an_empty_answer(service: Service) -> None:
    answer = service.client.post("/v1/maps/wall/distance", json={"points": []})
    assert (answer.status_code, answer.json()["distance_sigma"]) == (200, [])


def test_an_empty_map_answers_null_because_json_has_no_infinity(own_service: Service) -> None:
    empty = wall()
    model = empty.model.select((empty.model.means[:, 0] > 9).nonzero()[:, 0])
    own_service.store.add("void", source="nothing", state="static", snapshot=type(empty)(model, 1))
    answer = own_service.client.post("/v1/maps/void/distance", json={"points": [[0, 0, 0]]}).json()
    assert (answer["distance_sigma"], answer["index"], answer["inside"]) == ([None], [-1], [False])


def test_the_version_grows_with_the_map_and_answers_follow(own_service: Service) -> None:
    ask = {"points": [[0.0, 0.0, 2.0]]}
    before = own_service.client.post("/v1/maps/wall/distance", json=ask).json()
    own_service.store.publish("wall", wall(2, z=2.0))
    after = own_service.client.post("/v1/maps/wall/distance", json=ask).json()
    assert (before["map_version"], before["inside"]) == (1, [False])
    assert (after["map_version"], after["inside"]) == (2, [True])
    assert own_service.client.get("/v1/maps/wall").json()["map_version"] == 2
    assert own_service.client.get("/v1/maps/wall/render").headers["x-map-version"] == "2"


@pytest.mark.parametrize(
    ("body", "told"),
    [
        ('{"points": [[0, 0, NaN]]}', "points"),
        ('{"points": [[0, 0, 1], [0, 0, Infinity]]}', "points"),
        ('{"points": [[0, 0]]}', "points.0"),
        ('{"points": [[0, 0, "far"]]}', "points.0"),
        ('{"points": 5}', "points"),
        ('{"point": [[0, 0, 1]]}', "points"),
        ('{"points": [[0, 0, 1]], "n_sigma": 0}', "n_sigma"),
        ('{"points": [[0, 0, 1]], "n_sigma": -2}', "n_sigma"),
        ("{", "body"),
        ("", "body"),
    ],
)
def test_a_question_that_makes_no_sense_is_answered_with_the_field_at_fault(
    service: Service, body: str, told: str
) -> None:
    headers = {"content-type": "application/json"}
    problem = _problem(service.client.post("/v1/maps/wall/distance", content=body, headers=headers), 422)
    assert told in problem["detail"]
    assert "map_version" in problem or told == "body", "no map is looked up for what is no JSON"


def test_a_point_that_is_not_finite_is_named_by_its_row(service: Service) -> None:
    body = '{"points": [[0, 0, 1], [0, 0, NaN]]}'
    response = service.client.post("/v1/maps/wall/distance", content=body, headers={"content-type": "application/json"})
    assert "1" in _problem(response, 422)["detail"]


def test_more_points_than_allowed_are_refused_with_the_limit(service: Service) -> None:
    problem = _problem(service.client.post("/v1/maps/wall/distance", json={"points": [[0, 0, 0]] * 1001}), 413)
    assert "1000" in problem["detail"]
    assert problem["hint"]


def test_a_body_over_the_limit_is_refused(service: Service) -> None:
    problem = _problem(service.client.post("/v1/maps/wall/distance", json=" " * 200_001), 413)
    assert "200000 bytes" in problem["detail"]


@pytest.mark.parametrize(("method", "path"), [("GET", "/v1/maps/shelf"), ("POST", "/v1/maps/shelf/distance")])
def test_an_unknown_map_is_a_problem_that_names_the_known_ones(service: Service, method: str, path: str) -> None:
    problem = _problem(service.client.request(method, path, json={"points": []}), 404)
    assert "shelf" in problem["detail"]
    assert "wall" in problem["hint"]


def test_an_unknown_path_and_a_wrong_method_are_problems(service: Service) -> None:
    _problem(service.client.get("/v2/maps"), 404)
    response = service.client.get("/v1/maps/wall/distance")
    _problem(response, 405)
    assert response.headers["allow"] == "POST"


@pytest.mark.parametrize("mode", ["rgb", "depth", "normal", "alpha"])
def test_a_browser_gets_a_picture_of_the_whole_map(service: Service, mode: str) -> None:
    response = service.client.get("/v1/maps/wall/render", params={"mode": mode, "width": 80, "height": 60})
    image = _image(response)
    assert image.shape[:2] == (60, 80)
    assert response.headers["x-map-version"] == "1"
    assert image[30, 40].any(), "the wall fills the middle"
    if mode == "rgb":
        np.testing.assert_allclose(image[30, 40], [255, 51, 26], atol=3)


def test_a_given_camera_sees_the_wall_at_its_depth(service: Service) -> None:
    pose = np.eye(4).tolist()
    body = {"mode": "depth", "camera": CAMERA, "T_world_camera": pose, "depth_range_m": [0.5, 1.5]}
    response = service.client.post("/v1/maps/wall/render", json=body)
    near_end_is_red = cv2.applyColorMap(np.array([[128]], np.uint8), cv2.COLORMAP_TURBO)[0, 0, ::-1].astype(int)
    np.testing.assert_allclose(_image(response)[60, 80].astype(int), near_end_is_red, atol=6)
    assert response.headers["x-depth-range-m"] == "0.5000 1.5000"


def test_a_pose_as_quaternion_draws_what_the_same_pose_as_matrix_draws(service: Service) -> None:
    half = np.sqrt(0.5)
    matrix = [[0, 0, 1, -0.5], [0, 1, 0, 0], [-1, 0, 0, 1.2], [0, 0, 0, 1]]  # a quarter turn about y
    by_matrix = {"camera": CAMERA, "T_world_camera": matrix}
    by_quat = {"camera": CAMERA, "translation": [-0.5, 0, 1.2], "quaternion_wxyz": [half, 0, half, 0]}
    images = [_image(service.client.post("/v1/maps/wall/render", json=body)) for body in (by_matrix, by_quat)]
    assert images[0].any()
    assert int((np.abs(images[0].astype(int) - images[1].astype(int)) > 1).sum()) == 0


def test_a_picture_is_sent_again_only_after_the_map_has_changed(own_service: Service) -> None:
    first = own_service.client.get("/v1/maps/wall/render")
    tag = {"If-None-Match": first.headers["etag"]}
    same = own_service.client.get("/v1/maps/wall/render", headers=tag)
    assert (same.status_code, same.content, same.headers["etag"]) == (304, b"", first.headers["etag"])
    assert own_service.client.get("/v1/maps/wall/render", params={"mode": "depth"}, headers=tag).status_code == 200
    own_service.store.publish("wall", wall(2))
    assert own_service.client.get("/v1/maps/wall/render", headers=tag).status_code == 200


@pytest.mark.parametrize(
    ("body", "told"),
    [
        ({"T_world_camera": (np.eye(4) * 2).tolist()}, "T_world_camera"),
        ({"T_world_camera": np.eye(3).tolist()}, "T_world_camera"),
        ({"translation": [0, 0, 0]}, "quaternion_wxyz"),
        ({"translation": [0, 0, 0], "quaternion_wxyz": [0, 0, 0, 0]}, "quaternion_wxyz"),
        ({"translation": [0, 0, 0], "quaternion_wxyz": [1, 0, 0, 0], "T_world_camera": np.eye(4).tolist()}, "either"),
        ({"camera": CAMERA | {"fx": -1}}, "fx"),
        ({"camera": CAMERA | {"width": 0}}, "width"),
        ({"camera": {"fx": 200}}, "camera"),
        ({"mode": "xray"}, "mode"),
    ],
)
def test_a_view_that_makes_no_sense_is_answered_with_the_field_at_fault(
    service: Service, body: dict[str, Any], told: str
) -> None:
    assert told in _problem(service.client.post("/v1/maps/wall/render", json=body), 422)["detail"]


def test_a_view_of_too_many_pixels_is_refused_with_the_limit(service: Service) -> None:
    response = service.client.get("/v1/maps/wall/render", params={"width": 10_000, "height": 10_000})
    assert "307200" in _problem(response, 413)["detail"]


def test_the_api_describes_itself(service: Service) -> None:
    assert service.client.get("/docs").status_code == 200
    assert "/v1/maps/{map_id}/distance" in service.client.get("/openapi.json").json()["paths"]


def test_the_store_is_shared_not_copied(own_service: Service) -> None:
    assert isinstance(own_service.store, MapStore)
    own_service.store.set_state("wall", "failed", "the log broke at frame 7")
    described = own_service.client.get("/v1/maps/wall").json()
    assert (described["state"], described["detail"]) == ("failed", "the log broke at frame 7")

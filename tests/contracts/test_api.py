"""Every call of /v1 from a client's side: the documented examples, the typed client, arrays, jobs and motions."""

from __future__ import annotations

import io
from collections.abc import Iterator
from typing import Any

import cv2
import httpx
import msgpack
import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.client import Client, ServiceError
from splatbot.collision import RobotSpheres
from splatbot.gaussians import GaussianModel
from splatbot.geometry import pose_from_quat
from splatbot.logs import open_log
from splatbot.rasterize.views import render_view
from splatbot.robots.panda import panda
from splatbot.services.jobs import ENDED
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from splatbot.trajectory import Trajectory
from splatbot.workspace import Workspace
from tests.contracts.conftest import Service, running, table_with_box, wall
from tests.waiting import until

LOG = "synthetic:tabletop?frames=6&width=160&height=120&arc=4"
BASE = {"translation": [0.0, 0.5, 0.0], "quaternion_wxyz": [0.7071068, 0.7071068, 0.0, 0.0]}
HOME = [0.0, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785]


@pytest.fixture(scope="module")
def api(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    store = MapStore()
    path = Trajectory(np.arange(2.0), np.tile(np.eye(4), (2, 1, 1)))
    store.add("default", source="wall.ply", state="static", snapshot=wall(), trajectory=path)
    store.add("table", source="a table", state="static", snapshot=table_with_box())
    beside = Workspace(T_world_base=pose_from_quat(BASE["translation"], BASE["quaternion_wxyz"]))
    store.add("lab", source="wall.ply", state="static", snapshot=wall(), workspace=beside)
    store.add("tuesday", source="a table", state="static", snapshot=table_with_box())
    with running(ServiceSettings(data_dir=tmp_path_factory.mktemp("maps")), store) as service:
        with Client(service.url) as client:
            assert client.wait(client.create_map("monday", LOG)["id"])["state"] == "succeeded"
        yield service


@pytest.fixture
def robot(api: Service) -> Iterator[Client]:
    with Client(api.url) as client:
        yield client


def test_every_documented_example_is_answered_as_documented(api: Service) -> None:
    """Each request example of the OpenAPI document is posted; places of the URL take the documented example, too."""
    home = api.client.get("/v1/arms/fake").json()["position"]
    goal = [0.3, *home[1:]]
    plan = api.client.post("/v1/maps/lab/plans", json={"start": home, "goal": goal}).json()["id"]
    lease = api.client.post("/v1/arms/fake/lease", json={"seconds": 60}).json()["lease"]
    known = {"plan": plan, "lease": lease}
    asked = 0
    for path, item in api.client.get("/openapi.json").json()["paths"].items():
        for name, example in _examples(item.get("post", {})).items():
            where = path.replace("{map_id}", "default").replace("{name}", "twin").replace("{robot}", "panda")
            if where.endswith("/frames"):
                api.client.post("/v1/maps", json={"id": "frames"})
                where = "/v1/maps/frames/frames"
            if where.endswith("/grasps"):
                where = "/v1/maps/table/grasps"
            if where.endswith(("/versions", "/merge", "/diff")):
                where = where.replace("default", "monday")
            body = example | {field: value for field, value in known.items() if field in example}
            response = api.client.post(where, json=body)
            assert response.status_code in (200, 201, 202), f"{path}, {name}: {response.text}"
            asked += 1
    for job in api.runtime.jobs.list():
        api.runtime.jobs.cancel(job.id)  # the tests that follow need not wait for these requests
    until(lambda: all(job.state in ENDED for job in api.runtime.jobs.list()))  # nor see their maps change
    assert asked >= 23


def _examples(operation: dict[str, Any]) -> dict[str, Any]:
    content = operation.get("requestBody", {}).get("content", {}).get("application/json", {})
    return {name: example["value"] for name, example in content.get("examples", {}).items()}


def test_the_document_refers_to_nothing_that_it_does_not_hold(api: Service) -> None:
    document = api.client.get("/openapi.json")
    held = set(document.json()["components"]["schemas"])
    named = {part.split('"')[0] for part in document.text.split("#/components/schemas/")[1:]}
    assert named - held == set()


def test_points_travel_as_npy_and_msgpack_and_mean_the_same(api: Service) -> None:
    points = np.random.default_rng(3).uniform(-1, 1, (500, 3)).astype(np.float32)
    file = io.BytesIO()
    np.save(file, points)
    npy, packed = {"Content-Type": "application/x-npy"}, {"Content-Type": "application/msgpack"}
    url = "/v1/maps/default/distance"
    by_npy = api.client.post(url, content=file.getvalue(), headers=npy | {"Accept": "application/x-npy"})
    distance = np.load(io.BytesIO(by_npy.content))
    array = {"dtype": "<f4", "shape": [500, 3], "data": points.tobytes()}
    by_msgpack = api.client.post(url, content=msgpack.packb({"points": array}), headers=packed).json()
    by_json = api.client.post(url, json={"points": points.tolist()}).json()
    expected = api.store.get("default").field.mahalanobis(points)
    np.testing.assert_array_equal(distance, expected.distance)
    assert by_npy.headers["x-map-version"] == "1"
    np.testing.assert_allclose(by_json["distance_sigma"], expected.distance, rtol=1e-6)
    assert by_msgpack == by_json


def test_the_client_s_distances_are_the_field_s(api: Service, robot: Client) -> None:
    points = np.random.default_rng(4).uniform(-1, 1, (200, 3))
    found, expected = robot.distance("default", points), api.store.get("default").field.mahalanobis(points)
    np.testing.assert_array_equal(found.distance_sigma, expected.distance)
    np.testing.assert_array_equal(found.index, expected.index)
    assert (found.map_version, found.inside.dtype) == (1, np.bool_)


def test_collisions_are_those_of_the_arm_s_spheres_with_gradients(api: Service, robot: Client) -> None:
    q = panda().random(20, np.random.default_rng(5))
    found = robot.collisions("default", q, base=BASE, margin=0.01, gradient=True)
    T = np.eye(4)
    T[:3, :3], T[1, 3] = [[1, 0, 0], [0, 0, -1], [0, 1, 0]], 0.5
    arm, field = RobotSpheres(panda(), T_world_base=T, margin=0.01), api.store.get("default").field
    np.testing.assert_array_equal(found.in_collision, arm.check(field, q).in_collision)
    room = arm.clearance(field, q)
    np.testing.assert_allclose(found.clearance, room.distance, atol=1e-6)
    assert found.gradient is not None
    np.testing.assert_allclose(found.gradient, room.gradient, atol=1e-5)


def test_an_arm_whose_base_nobody_knows_is_asked_for_it(robot: Client) -> None:
    with pytest.raises(ServiceError, match="not known") as caught:
        robot.collisions("default", [HOME])
    assert (caught.value.status, caught.value.field) == (422, "base")


def test_views_of_several_cameras_come_in_one_answer(api: Service, robot: Client) -> None:
    camera = {"fx": 100.0, "fy": 100.0, "cx": 39.5, "cy": 29.5, "width": 80, "height": 60}
    small = camera | {"width": 40}
    drawn = robot.views(
        "default",
        [{"camera": camera, "pose": {}}, {"camera": small, "pose": {"translation": [0, 0, 0.5]}}],
        ["rgb", "depth"],
    )
    assert [view["rgb"].shape for view in drawn] == [(60, 80, 3), (60, 40, 3)]
    expected = render_view(wall().model, Camera(100, 100, 39.5, 29.5, 80, 60), np.eye(4), "depth")
    np.testing.assert_allclose(drawn[0]["depth"], expected, atol=1e-6)
    assert drawn[1]["depth"][30, 20] == pytest.approx(0.5, abs=0.01)


def test_a_plan_is_followed_watched_and_ends_where_it_should(api: Service, robot: Client) -> None:
    at = api.client.get("/v1/arms/twin").json()["position"]
    goal = [at[0] + 0.2, *at[1:]]
    plan = robot.plan("lab", start=at, goal=goal, budget_ms=500)
    assert plan["certified"]
    lease = robot.lease("twin", preempt=True)
    motion = lease.send(plan["id"], key="once")
    assert lease.send(plan["id"], key="once")["id"] == motion["id"], "a repeated request moves the arm once"
    events = list(robot.events(f"/v1/trajectories/{motion['id']}/events"))
    assert events[-1][0] == "succeeded"
    assert "feedback" in {name for name, _ in events}
    np.testing.assert_allclose(api.client.get("/v1/arms/twin").json()["position"], goal, atol=0.02)
    with lease, pytest.raises(ServiceError, match="where the arm is") as caught:
        lease.send(plan["id"])
    assert caught.value.status == 409


def test_a_motion_that_is_stopped_is_cancelled_and_the_arm_stands_still(api: Service, robot: Client) -> None:
    at = api.client.get("/v1/arms/twin").json()["position"]
    plan = robot.plan("lab", start=at, goal=[at[0] - 0.6, *at[1:]], speed=0.05)
    with robot.lease("twin", preempt=True) as lease:
        motion = lease.send(plan["id"])
        with pytest.raises(ServiceError, match="is moving"):
            lease.send(plan["id"])
        robot.stop(motion["id"])
        assert robot.wait(motion["id"], under="/v1/trajectories", timeout_s=20)["state"] == "cancelled"
    assert api.client.get("/v1/arms/twin").json()["busy"] is False


def test_a_plan_into_the_wall_is_a_problem_with_moveit_s_code(robot: Client) -> None:
    far = {"translation": [0.0, 3.0, 0.0], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}
    with pytest.raises(ServiceError) as caught:
        robot.plan("default", goal_pose=far, base=BASE)
    assert (caught.value.status, caught.value.code) == (422, -31)


def test_grasps_of_a_box_are_as_wide_as_it_is_and_one_that_is_not_there_is_a_problem(robot: Client) -> None:
    found = robot.grasps("table", target="box", base={})
    best = found["grasps"][0]
    assert (found["margin_m"], found["arm_margin_m"]) == (0.0, 0.0)
    assert found["margin_source"] == "unknown: the map has no recording; 0 is assumed"
    assert best["width_m"] == pytest.approx(0.04, abs=0.005) or best["width_m"] == pytest.approx(0.06, abs=0.005)
    assert best["q"] is not None
    with pytest.raises(ServiceError) as caught:
        robot.grasps("table", target="blue cup", base={})
    assert caught.value.status == 422


def test_ik_reaches_the_pose(robot: Client) -> None:
    pose = {"translation": [0.4, 0.2, 0.4], "quaternion_wxyz": [0.0, 1.0, 0.0, 0.0]}
    for q in robot.ik(pose):
        np.testing.assert_allclose(panda().tcp(q)[:3, 3], [0.4, 0.2, 0.4], atol=1e-5)


def test_a_log_is_mapped_by_a_job_that_can_be_watched_and_its_map_exported(api: Service, robot: Client) -> None:
    job = robot.create_map("mapped", LOG, key="k1")
    assert robot.create_map("mapped", LOG, key="k1")["id"] == job["id"]
    events = list(robot.events(f"/v1/jobs/{job['id']}/events"))
    assert events[-1][0] == "succeeded", events[-1]
    assert events[-1][1]["result"]["frames"] == 6
    described = robot.map("mapped")
    assert (described["state"], described["gaussians"] > 500) == ("ended", True)
    response = api.client.get("/v1/maps/mapped/splats.ply")
    assert response.content.startswith(b"ply")
    assert api.client.get("/v1/maps/mapped/splats.exe").status_code == 422
    again = api.client.get("/v1/maps/mapped/splats.ply", headers={"If-None-Match": response.headers["etag"]})
    assert (again.status_code, again.content) == (304, b"")
    path = api.client.get("/v1/maps/mapped/trajectory").json()
    assert np.array(path["T_world_camera"]).shape == (6, 4, 4)
    robot.delete_map("mapped")
    assert api.client.get("/v1/maps/mapped").status_code == 404


def test_the_exported_file_is_the_map(api: Service, tmp_path: Any) -> None:
    (tmp_path / "map.ply").write_bytes(api.client.get("/v1/maps/default/splats.ply").content)
    np.testing.assert_allclose(GaussianModel.load(tmp_path / "map.ply").means, wall().model.means, atol=1e-6)


def test_pushed_frames_are_mapped_as_the_log_they_come_from(api: Service, robot: Client) -> None:
    log = open_log(LOG)
    robot.create_map("pushed")
    assert api.client.get("/readyz").status_code == 200, "a map that a client made is not waited for"
    placed = [robot.push("pushed", frame) for frame in log]
    assert [p.verdict for p in placed] == ["ok"] * 6
    truth = log.ground_truth
    assert truth is not None
    first = np.linalg.inv(truth.T_world_camera[0])
    for p, T in zip(placed, truth.T_world_camera, strict=True):
        assert p.T_world_camera is not None
        np.testing.assert_allclose(p.T_world_camera[:3, 3], (first @ T)[:3, 3], atol=0.02)
    robot.end("pushed")
    until(lambda: robot.map("pushed")["state"] != "mapping")
    with pytest.raises(ServiceError, match="no more frames"):
        robot.push("pushed", log.read(0))


def test_a_frame_for_a_map_that_takes_none_or_of_nonsense_is_refused(api: Service, robot: Client) -> None:
    frame = open_log(LOG).read(0)
    with pytest.raises(ServiceError, match="not made of pushed frames"):
        robot.push("default", frame)
    robot.create_map("strict")
    bad = {"stamp": 0.0, "camera": {"fx": 1, "fy": 1, "cx": 1, "cy": 1, "width": 8, "height": 6}}
    bomb = cv2.imencode(".png", np.zeros((4000, 4000, 3), np.uint8))[1].tobytes()
    depth = {"dtype": "<f4", "shape": [6, 8], "data": np.ones((6, 8), np.float32).tobytes()}
    for rgb, status in ((bomb, 413), (b"GIF89a", 422), (b"\x89PNG\r\n\x1a\n" + b"\0" * 30, 422), ("!", 422), (7, 422)):
        body = msgpack.packb(bad | {"rgb": rgb, "depth": depth})
        response = api.client.post(
            "/v1/maps/strict/frames", content=body, headers={"Content-Type": "application/msgpack"}
        )
        assert response.status_code == status, (rgb if isinstance(rgb, str | int) else rgb[:8], response.text)


def test_a_job_is_cancelled_and_what_was_mapped_is_kept(api: Service, robot: Client) -> None:
    job = robot.create_map("long", "synthetic:tabletop?frames=500&width=160&height=120")
    until(lambda: robot.map("long")["map_version"])
    assert api.client.delete(f"/v1/jobs/{job['id']}").status_code == 200
    assert robot.wait(job["id"], timeout_s=60)["state"] == "cancelled"
    assert robot.map("long")["gaussians"] > 0


@pytest.mark.parametrize("path", ["/v1/jobs/nope", "/v1/trajectories/nope", "/v1/plans/nope"])
def test_what_is_not_there_is_404_also_as_a_stream(api: Service, path: str) -> None:
    for where in (path, f"{path}/events"):
        response = api.client.get(where)
        assert (response.status_code, response.headers["content-type"]) == (404, "application/problem+json")


def test_trials_in_the_twin_are_a_job_with_a_result_for_each(api: Service, robot: Client) -> None:
    response = api.client.post("/v1/sim/trials", json={"scene": "empty", "trials": 2, "seed": 1})
    assert response.status_code == 202
    assert response.headers["location"] == f"/v1/jobs/{response.json()['id']}"
    assert response.headers["retry-after"]
    job = robot.wait(response.json()["id"], timeout_s=60)
    assert job["state"] == "succeeded", job
    assert [trial["seed"] for trial in job["result"]["trials"]] == [1, 2]


def test_a_plan_is_tried_in_the_twin_of_the_map_it_was_made_in(api: Service, robot: Client) -> None:
    """A motion that is certified in the map has no contact in its twin; 90 cm nearer to the wall it has."""
    plan = robot.plan("default", goal=[0.3, *HOME[1:]], base=BASE)
    near = BASE | {"translation": [0.0, 0.5, 0.9]}
    touched = []
    for base in (BASE, near):
        asked = {"map": "default", "plan": plan["id"], "base": base}
        response = api.client.post("/v1/sim/trials", json=asked)
        assert response.status_code == 202, response.text
        job = robot.wait(response.json()["id"], timeout_s=60)
        assert job["state"] == "succeeded", job
        assert job["result"]["map"] == "default"
        (trial,) = job["result"]["trials"]
        assert any("ellipsoids" in note for note in trial["notes"])
        touched.append(bool(trial["contacts"]))
    assert touched == [False, True]


@pytest.mark.parametrize(
    ("asked", "field"),
    [
        ({"map": "default"}, "plan"),
        ({"map": "default", "scene": "empty"}, "scene"),
        ({"map": "default", "plan": "nope"}, "plan"),
    ],
)
def test_trials_in_a_map_need_a_plan_and_no_scene(api: Service, asked: dict[str, str], field: str) -> None:
    response = api.client.post("/v1/sim/trials", json=asked)
    assert response.status_code in (404, 422)
    assert response.json()["field"] == field


@pytest.mark.parametrize("id", ["..", "a/b", "UP", "", "-x", "x" * 65])
def test_a_map_s_name_cannot_lead_elsewhere(api: Service, id: str) -> None:
    assert api.client.post("/v1/maps", json={"id": id}).status_code == 422


@pytest.mark.parametrize("log", ["/etc", "../..", "/", "x\x00y", "file:///etc", "", "~", "." * 5000])
def test_a_log_outside_of_the_allowed_folders_is_refused_whether_or_not_it_is_there(api: Service, log: str) -> None:
    response = api.client.post("/v1/maps", json={"id": "evil", "log": log})
    assert response.status_code == 422
    assert "no recording that may be mapped" in response.json()["detail"]
    assert api.client.get("/v1/maps/evil").status_code == 404


def test_a_name_that_is_taken_is_a_conflict(api: Service) -> None:
    assert api.client.post("/v1/maps", json={"id": "default"}).status_code == 409


@pytest.mark.parametrize("field", ["robot", "scene"])
def test_names_of_robots_and_scenes_are_no_paths(api: Service, field: str) -> None:
    url, body = (
        ("/v1/maps/default/collisions", {"q": [HOME], "base": BASE, "robot": "/etc/hosts.json"})
        if field == "robot"
        else ("/v1/sim/trials", {"scene": "/etc/hosts"})
    )
    response = api.client.post(url, json=body)
    assert (response.status_code, response.json()["field"]) == (422, field)


def test_what_is_measured_is_told_to_prometheus(api: Service) -> None:
    api.client.get("/v1/maps/default")
    text = api.client.get("/metrics").text
    assert 'splatbot_map_gaussians{map="default"} 2601.0' in text
    assert 'splatbot_request_seconds_count{method="GET",route="/v1/maps/{map_id}",status="200"}' in text
    assert "splatbot_bus_dropped" in text


def test_a_request_keeps_its_id_unless_it_is_nonsense(api: Service) -> None:
    given = api.client.get("/healthz", headers={"X-Request-ID": "robot-7.a"})
    made = api.client.get("/healthz", headers={"X-Request-ID": "x" * 100})
    assert given.headers["x-request-id"] == "robot-7.a"
    assert len(made.headers["x-request-id"]) == 16


def test_a_body_of_an_unknown_kind_is_refused_with_the_known_ones(api: Service) -> None:
    response = api.client.post("/v1/maps/default/distance", content=b"x", headers={"Content-Type": "text/plain"})
    assert response.status_code == 415
    assert "application/x-npy" in response.json()["detail"]


def test_a_service_that_is_not_there_is_a_clear_error() -> None:
    with pytest.raises(ServiceError, match="no answer"):
        Client("http://127.0.0.1:9", timeout_s=2).maps()


def test_httpx_and_the_client_see_the_same_maps(api: Service, robot: Client) -> None:
    assert isinstance(api.client, httpx.Client)
    assert robot.maps() == api.client.get("/v1/maps").json()["maps"]

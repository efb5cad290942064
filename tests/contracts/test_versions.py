"""Versions, merge and diff over HTTP, on a real socket: answers after a restoration, and the rights of keys."""

from __future__ import annotations

import subprocess
import threading
import time
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest

from splatbot.client import Client, ServiceError
from splatbot.config import Config
from splatbot.errors import SplatbotError
from splatbot.gaussians import Snapshot
from splatbot.geometry import inverse, se3_exp
from splatbot.logs import open_log
from splatbot.services.keys import hash_key, new_key
from splatbot.services.settings import ServiceSettings
from splatbot.services.version_files import read_version
from splatbot.slam import Slam
from splatbot.trajectory import Trajectory
from tests.contracts.conftest import Service, running, wall, wall_store

QUICK = Config.model_validate({"mapping": {"refine_iterations": 2, "final_iterations": 3}})
BEFORE = "synthetic:tabletop?frames=30&rate=6&width=160&height=120"
AFTER = "synthetic:tabletop_removed?event=0&frames=30&rate=6&width=160&height=120&trajectory=arm"


def _distance(service: Service, map_id: str = "desk") -> tuple[float | None, int]:
    """Return the distance of a point at 0.5 m to a map [m], None beyond 1 m, and the version that answers."""
    answer = service.client.post(f"/v1/maps/{map_id}/distance", json={"points": [[0.0, 0.0, 0.5]]}).json()
    return answer["distance_m"][0], answer["map_version"]


@pytest.fixture
def api(tmp_path: Path) -> Iterator[Service]:
    """A service with the map "desk", a wall at 1 m that was mapped."""
    with running(ServiceSettings(data_dir=tmp_path, requests_per_s=1e6, max_versions=4)) as service:
        service.store.add("desk", source="a log", state="ended", snapshot=wall(5))
        yield service


def _published(service: Service, version: int, z: float) -> None:
    service.store.publish("desk", wall(version, z=z))


def test_after_a_restoration_every_answer_is_that_of_the_version(api: Service) -> None:
    saved = api.client.post("/v1/maps/desk/versions", json={"label": "near"})
    assert (saved.status_code, saved.headers["location"]) == (201, "/v1/maps/desk/versions/1")
    assert api.client.get(saved.headers["location"]).json() == saved.json()
    _published(api, 6, 2.0)
    near = 0.5  # [m] from the point to a wall at 1 m; the one at 2 m is beyond the cut of distances
    assert _distance(api) == (None, 6)
    made = api.client.post("/v1/maps/desk/versions/1/restore").json()
    assert (made["number"], made["parent"], made["restored_from"], made["map_version"]) == (3, 1, 1, 7)
    assert _distance(api) == (pytest.approx(near, abs=0.01), 7)
    listed = api.client.get("/v1/maps/desk/versions").json()
    assert [v["note"] for v in listed["versions"]] == [None, "before version 1 again", "version 1 again"]
    assert [v["in_use"] for v in listed["versions"]] == [False, False, True]
    back = api.client.post("/v1/maps/desk/versions/2/restore").json()  # the state before is not lost
    assert back["map_version"] == 8
    assert _distance(api) == (None, 8)


def test_a_restart_serves_the_restored_state_with_its_versions(tmp_path: Path) -> None:
    settings = ServiceSettings(data_dir=tmp_path)
    with running(settings) as service:
        service.store.add("desk", source="a log", state="ended", snapshot=wall(5))
        service.client.post("/v1/maps/desk/versions", json={"label": "near"})
        _published(service, 6, 2.0)
        service.client.post("/v1/maps/desk/versions/1/restore")
    with running(settings) as service:
        assert _distance(service) == (pytest.approx(0.5, abs=0.01), 7)
        versions = service.client.get("/v1/maps/desk/versions").json()["versions"]
        assert [(v["number"], v["in_use"], v["restorable"]) for v in versions] == [
            (1, False, True),
            (2, False, True),
            (3, True, True),
        ]
        assert service.client.post("/v1/maps/desk/versions/2/restore").json()["map_version"] == 8


def test_a_cached_copy_of_a_deleted_map_is_not_current_for_the_next_map_of_its_name(api: Service) -> None:
    first = api.client.get("/v1/maps/desk/splats.ply")
    kept = {"If-None-Match": first.headers["etag"]}
    assert api.client.get("/v1/maps/desk/splats.ply", headers=kept).status_code == 304
    assert api.client.delete("/v1/maps/desk").status_code == 204
    api.store.add("desk", source="a log", state="ended", snapshot=wall(5, z=2.0))
    second = api.client.get("/v1/maps/desk/splats.ply", headers=kept)
    assert (second.status_code, second.content != first.content) == (200, True)


def test_a_restored_version_without_a_path_leaves_no_path_of_the_state_before(api: Service) -> None:
    api.client.post("/v1/maps/desk/versions", json={})
    path = Trajectory(np.arange(3.0), np.tile(np.eye(4), (3, 1, 1)))
    api.store.publish("desk", wall(6), path)
    assert len(api.client.get("/v1/maps/desk/trajectory").json()["stamps"]) == 3
    api.client.post("/v1/maps/desk/versions/1/restore")
    assert api.client.get("/v1/maps/desk/trajectory").json()["stamps"] == []


def test_a_repeated_diff_with_its_key_is_the_same_job_after_its_maps_are_gone(api: Service) -> None:
    api.store.add("shelf", source="a log", state="ended", snapshot=wall(1))
    headers = {"Idempotency-Key": "once"}
    first = api.client.post("/v1/maps/desk/diff", json={"other": "shelf"}, headers=headers)
    api.client.delete("/v1/maps/shelf")
    again = api.client.post("/v1/maps/desk/diff", json={"other": "shelf"}, headers=headers)
    assert (again.status_code, again.json()["id"]) == (202, first.json()["id"])


def test_two_restorations_at_once_are_two_states_one_after_the_other(api: Service) -> None:
    for version, z in ((6, 1.2), (7, 1.3)):
        api.client.post("/v1/maps/desk/versions", json={"label": f"{version - 1}"})
        _published(api, version, z)
    answers: list[httpx.Response] = []

    def restore(number: int) -> None:
        answers.append(api.client.post(f"/v1/maps/desk/versions/{number}/restore"))

    api.client.post("/v1/maps/desk/versions", json={})
    threads = [threading.Thread(target=restore, args=(number,)) for number in (1, 2)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert sorted(a.status_code for a in answers) in ([200, 200], [200, 409])  # 409: only labelled versions are left
    made = [a.json() for a in answers if a.status_code == 200]
    assert len({m["map_version"] for m in made}) == len(made)
    latest = max(made, key=lambda m: m["map_version"])
    assert _distance(api) == (pytest.approx({1: 0.5, 2: 0.7}[latest["restored_from"]], abs=0.01), latest["map_version"])


def test_deleting_restoring_and_saving_from_many_threads_never_fails_or_serves_another_state(api: Service) -> None:
    statuses: list[int] = []
    for version in (6, 7):
        api.client.post("/v1/maps/desk/versions", json={})
        _published(api, version, 1.0)

    def work(method: str, path: str) -> None:
        for _ in range(5):
            statuses.append(
                api.client.request(method, path, json={} if path.endswith("versions") else None).status_code
            )

    calls = [("POST", "versions"), ("POST", "versions/1/restore"), ("DELETE", "versions/1"), ("DELETE", "versions/2")]
    threads = [threading.Thread(target=work, args=(method, f"/v1/maps/desk/{path}")) for method, path in calls]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert set(statuses) <= {200, 201, 204, 404, 409}, set(statuses)
    assert _distance(api)[0] == pytest.approx(0.5, abs=0.01)
    versions = api.client.get("/v1/maps/desk/versions").json()["versions"]
    assert len(versions) <= 4


def test_a_map_that_is_deleted_while_it_is_restored_is_gone(api: Service) -> None:
    api.client.post("/v1/maps/desk/versions", json={})
    _published(api, 6, 2.0)
    threads = [
        threading.Thread(target=api.client.post, args=("/v1/maps/desk/versions/1/restore",)),
        threading.Thread(target=api.client.delete, args=("/v1/maps/desk",)),
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert api.client.get("/v1/maps/desk").status_code == 404
    assert api.runtime.history.versions.of_map("desk") == []
    api.store.add("desk", source="another log", state="ended", snapshot=wall(1))
    assert api.client.get("/v1/maps/desk/versions").json()["versions"] == []


@pytest.mark.parametrize(
    ("body", "field"),
    [
        ({"label": ""}, "label"),
        ({"label": "a" * 65}, "label"),
        ({"label": "a\nb"}, "label"),
        ({"label": "a\x00"}, "label"),
        ({"label": "\x1b[31m"}, "label"),
        ({"note": "a" * 501}, "note"),
        ({"folder": "../../etc"}, "folder"),
        ({"number": 1}, "number"),
    ],
)
def test_texts_that_are_long_or_hold_control_characters_are_refused(
    api: Service, body: dict[str, Any], field: str
) -> None:
    refused = api.client.post("/v1/maps/desk/versions", json=body)
    assert refused.status_code == 422
    assert field in refused.json()["detail"]
    assert api.client.get("/v1/maps/desk/versions").json()["versions"] == []


def test_a_lone_surrogate_is_no_label(api: Service) -> None:
    body, headers = b'{"label": "\\ud800"}', {"content-type": "application/json"}
    assert api.client.post("/v1/maps/desk/versions", content=body, headers=headers).status_code == 422


@pytest.mark.parametrize("number", ["0", "-1", "1.5", "9" * 30, "%2e%2e%2f%2e%2e", "1%00", "x"])
def test_a_number_that_is_none_leads_nowhere(api: Service, number: str) -> None:
    api.client.post("/v1/maps/desk/versions", json={})
    for method, path in (("GET", ""), ("POST", "/restore"), ("DELETE", "")):
        answer = api.client.request(method, f"/v1/maps/desk/versions/{number}{path}")
        assert answer.status_code in (404, 405, 422), (method, number, answer.text)
    assert len(api.client.get("/v1/maps/desk/versions").json()["versions"]) == 1


def test_a_service_without_a_data_folder_names_the_setting_and_a_file_keeps_no_versions(tmp_path: Path) -> None:
    with running(ServiceSettings(), wall_store()) as service:
        for method, path in (("GET", ""), ("POST", ""), ("POST", "/1/restore"), ("DELETE", "/1")):
            body: dict[str, Any] | None = {} if (method, path) == ("POST", "") else None
            answer = service.client.request(method, f"/v1/maps/wall/versions{path}", json=body)
            assert answer.status_code == 409
            assert "--data" in answer.json()["hint"]
        asked = service.client.post("/v1/maps/wall/diff", json={"other": "wall", "version": 1})
        assert (asked.status_code, "--data" in asked.json()["hint"]) == (409, True)
    with running(ServiceSettings(data_dir=tmp_path), wall_store()) as service:
        answer = service.client.post("/v1/maps/wall/versions", json={})
        assert (answer.status_code, "is a file" in answer.json()["detail"]) == (422, True)


def test_a_later_map_of_the_name_of_a_file_does_not_go_back_to_another_world(tmp_path: Path) -> None:
    settings = ServiceSettings(data_dir=tmp_path)
    with running(settings) as service:
        service.store.add("desk", source="a log", state="ended", snapshot=wall(5))
        service.client.post("/v1/maps/desk/versions", json={})
    subprocess.run(["rm", "-r", tmp_path / "desk"], check=True)
    with running(settings) as service:
        service.store.add("desk", source="another log", state="ended", snapshot=wall(9))
        (old,) = service.client.get("/v1/maps/desk/versions").json()["versions"]
        assert (old["restorable"], old["in_use"]) == (False, False)
        answer = service.client.post("/v1/maps/desk/versions/1/restore")
        assert (answer.status_code, "earlier map of that name" in answer.json()["detail"]) == (409, True)


def test_a_damaged_version_is_named_without_a_path_and_the_map_stays(api: Service, tmp_path: Path) -> None:
    api.client.post("/v1/maps/desk/versions", json={})
    _published(api, 6, 1.2)
    (ply,) = (tmp_path / ".versions" / "files").glob("*/map/map.ply")
    data = bytearray(ply.read_bytes())
    data[len(data) // 2] ^= 1
    ply.write_bytes(data)
    answer = api.client.post("/v1/maps/desk/versions/1/restore")
    assert (answer.status_code, str(tmp_path) in answer.text) == (500, False)
    assert "version 1 of map 'desk' is damaged" in answer.json()["detail"]
    assert _distance(api) == (pytest.approx(0.7, abs=0.01), 6)


KEYS = {"read": new_key(), "one": new_key(), "two": new_key()}


@pytest.fixture
def shared(tmp_path: Path) -> Iterator[Service]:
    """A service of three keys, with small quotas."""
    hashes = (hash_key(KEYS["read"], ("read",)), *(hash_key(KEYS[n], ("read", "map")) for n in ("one", "two")))
    settings = ServiceSettings(
        data_dir=tmp_path,
        api_keys=hashes,
        max_client_maps=2,
        max_client_jobs=1,
        max_client_bytes=1_000_000,
        job_workers=1,
    )
    with running(settings) as service:
        yield service


def _of(service: Service, name: str) -> httpx.Client:
    return httpx.Client(base_url=service.url, headers={"X-API-Key": KEYS[name]}, timeout=60)


def test_reading_keys_list_and_compare_and_nothing_else(shared: Service) -> None:
    shared.store.add("desk", source="a log", state="ended", snapshot=wall(5))
    with _of(shared, "one") as one, _of(shared, "read") as read:
        assert one.post("/v1/maps/desk/versions", json={}).status_code == 201
        assert read.get("/v1/maps/desk/versions").status_code == 200
        assert read.get("/v1/quota").status_code == 200
        assert read.post("/v1/maps/desk/diff", json={"other": "desk", "version": 1}).status_code == 409  # no keyframes
        for method, path, body in (
            ("POST", "versions", {}),
            ("POST", "versions/1/restore", None),
            ("DELETE", "versions/1", None),
            ("POST", "merge", {"id": "a", "other": "desk"}),
        ):
            answer = read.request(method, f"/v1/maps/desk/{path}", json=body)
            assert (answer.status_code, "map" in answer.json()["detail"]) == (403, True)


def test_a_key_s_maps_jobs_and_bytes_are_bounded_and_those_of_another_key_are_not(shared: Service) -> None:
    long = "synthetic:tabletop?frames=500&width=160&height=120"
    with _of(shared, "one") as one, _of(shared, "two") as two:
        assert [one.post("/v1/maps", json={"id": f"a{k}"}).status_code for k in range(3)] == [201, 201, 403]
        refused = one.post("/v1/maps", json={"id": "a3"})
        assert ("retry-after" in refused.headers, "2 maps already" in refused.json()["detail"]) == (False, True)
        assert two.post("/v1/maps", json={"id": "b0"}).status_code == 201
        one.delete("/v1/maps/a1")
        first = one.post("/v1/maps", json={"id": "a1", "log": long})
        assert first.status_code == 202
        more = one.post("/v1/sim/trials", json={"scene": "empty"})
        assert (more.status_code, more.headers["retry-after"]) == (429, "1")
        assert "1 jobs of this client" in more.json()["detail"]
        other = two.post("/v1/sim/trials", json={"scene": "empty"})
        assert other.status_code == 202
        quota = one.get("/v1/quota").json()
        assert (quota["maps"], quota["jobs"]) == ({"used": 2, "most": 2}, {"used": 1, "most": 1})
        assert two.get("/v1/quota").json()["maps"] == {"used": 1, "most": 2}
        one.delete("/v1/maps/a1")
        two.delete(f"/v1/jobs/{other.json()['id']}")
        one.delete(f"/v1/jobs/{first.json()['id']}")


def test_a_key_beyond_its_bytes_makes_no_map_version_or_frame(shared: Service) -> None:
    frame = open_log(BEFORE).read(0)
    with _of(shared, "one") as one, _of(shared, "two") as two:
        one.post("/v1/maps", json={"id": "a"})
        served = shared.store.get("a")
        model = wall(1).model
        count = 1 + 1_000_000 // model.nbytes
        big = type(model)(*(t.repeat(count, *[1] * (t.dim() - 1)) for t in model._tensors()))
        shared.store.publish("a", Snapshot(big, 1))
        assert one.get("/v1/quota").json()["bytes"]["used"] == big.nbytes
        assert one.post("/v1/maps", json={"id": "b"}).status_code == 403
        assert one.post("/v1/maps/a/versions", json={}).status_code == 403
        assert two.post("/v1/maps", json={"id": "b"}).status_code == 201
        with Client(shared.url, key=KEYS["one"]) as robot, pytest.raises(ServiceError, match="bytes") as caught:
            robot.push("a", frame)
        assert (caught.value.status, served.owner == one.get("/v1/quota").json()["client"]) == (403, True)


def test_a_restoration_of_another_client_s_version_counts_in_the_caller_s_bytes(shared: Service) -> None:
    shared.store.add("desk", source="a log", state="ended", snapshot=wall(5))
    with _of(shared, "one") as one, _of(shared, "two") as two:
        size = one.post("/v1/maps/desk/versions", json={}).json()["bytes"]
        shared.store.publish("desk", wall(6))
        one.post("/v1/maps/desk/versions", json={})
        shared.runtime.settings.max_client_bytes = size - 1
        refused = two.post("/v1/maps/desk/versions/1/restore")
        assert (refused.status_code, "bytes" in refused.json()["detail"]) == (403, True)
        assert two.get("/v1/maps/desk").json()["map_version"] == 6
        assert one.post("/v1/maps/desk/versions/1/restore").status_code == 200  # it has the files already


def test_a_restored_version_with_a_pending_loop_closure_is_recorded_as_the_corrected_map(tmp_path: Path) -> None:
    log = open_log("synthetic:tabletop?frames=24&width=160&height=120&arc=24")
    move = se3_exp(np.array([0.1, 0.0, 0.0, 0.0, 0.0, 0.0]))
    with running(ServiceSettings(data_dir=tmp_path), config=QUICK) as service, Client(service.url) as robot:
        robot.create_map("live")
        for index in range(4):
            robot.push("live", log.read(index))
        served = service.store.get("live")
        with service.runtime.history._paused(served) as mapping:
            assert mapping is not None
            assert isinstance(mapping.mapper, Slam)
            loops = mapping.mapper._mapper.loops
            loops.correction = dict.fromkeys(loops.graph.poses, move)
        saved = robot.save_version("live")
        made = robot.restore("live", saved["number"])
        now = service.store.get("live")
        assert (made["restored_from"], made["map_version"]) == (saved["number"], now.map_version)
        versions = service.runtime.history.versions
        version = versions.get("live", made["number"])
        with versions.pinned(version) as folder:
            kept = read_version(version, folder)["snapshot"].model
        with versions.pinned(versions.get("live", saved["number"])) as folder:
            before = read_version(version, folder)["snapshot"].model
        np.testing.assert_array_equal(kept.means, now.ready.model.means)
        assert len(kept.means) != len(before.means) or not np.allclose(kept.means, before.means, atol=0.05)


def test_a_stream_goes_on_from_the_restored_version_and_finds_its_camera_again(tmp_path: Path) -> None:
    """The frames after a restoration are placed in the world of the version, to the truth of the synthetic log."""
    log = open_log("synthetic:tabletop?frames=24&width=160&height=120&arc=24")
    truth = log.ground_truth
    assert truth is not None
    with running(ServiceSettings(data_dir=tmp_path), config=QUICK) as service, Client(service.url) as robot:
        robot.create_map("live")
        for index in range(8):
            robot.push("live", log.read(index))
        saved = robot.save_version("live", "eight frames")
        assert saved["keyframes"] >= 1
        for index in range(8, 16):
            robot.push("live", log.read(index))
        grown = robot.map("live")
        assert grown["map_version"] > saved["map_version"]
        made = robot.restore("live", saved["number"])
        described = robot.map("live")
        assert (described["state"], described["gaussians"]) == ("mapping", saved["gaussians"])
        assert described["map_version"] == made["map_version"] > grown["map_version"]
        path = service.client.get("/v1/maps/live/trajectory").json()
        assert len(path["stamps"]) == 8
        elsewhere = open_log("synthetic:corridor?frames=2&width=160&height=120").read(0)
        lost = robot.push("live", replace(elsewhere, camera=log.camera, stamp=99.0))
        assert (lost.verdict, robot.map("live")["gaussians"]) == ("lost", saved["gaussians"])
        first = robot.push("live", replace(log.read(6), stamp=100.0))  # back where the version knows the place
        assert first.reasons == ["found again, the next frame must confirm it"]
        errors: list[float] = []
        for index in (6, 7, 5, 4):
            placed = robot.push("live", replace(log.read(index), stamp=100.1 + 0.1 * len(errors)))
            assert placed.T_world_camera is not None, placed.reasons
            expected = inverse(truth.T_world_camera[0]) @ truth.T_world_camera[index]
            errors.append(float(np.linalg.norm(placed.T_world_camera[:3, 3] - expected[:3, 3])))
        assert max(errors) < 0.02
        robot.end("live")
        _until(lambda: robot.map("live")["state"] == "ended")
        ended = robot.versions("live")[-1]
        assert (ended["note"], ended["in_use"], ended["keyframes"] >= saved["keyframes"]) == (
            "end of mapping",
            True,
            True,
        )


def test_a_stream_cannot_go_back_to_a_state_without_a_mapper(tmp_path: Path) -> None:
    with running(ServiceSettings(data_dir=tmp_path), config=QUICK) as service, Client(service.url) as robot:
        robot.create_map("live")
        served = service.store.get("live")
        service.store.publish("live", wall(1))
        service.runtime.history.versions.save(service.store.get("live"), None, owner="")
        service.store.publish("live", wall(2))
        with pytest.raises(ServiceError, match="no state to map from") as caught:
            robot.restore("live", 1)
        assert (caught.value.status, robot.map("live")["map_version"], served.state) == (409, 2, "mapping")


def _until(found: Callable[[], object]) -> None:
    deadline = time.monotonic() + 60
    while not found():
        assert time.monotonic() < deadline
        time.sleep(0.05)


@pytest.fixture(scope="module")
def tables(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Service]:
    """A service that has mapped a simulated table top before and after its carton is removed, on two paths."""
    settings = ServiceSettings(data_dir=tmp_path_factory.mktemp("maps"), requests_per_s=1e6)
    with running(settings, config=QUICK) as service, Client(service.url) as robot:
        for name, log in (("monday", BEFORE), ("tuesday", AFTER)):
            job = robot.wait(robot.create_map(name, log)["id"])
            assert job["state"] == "succeeded", job
        yield service


def _first_pose(log: str) -> np.ndarray:
    truth = open_log(log).ground_truth
    assert truth is not None
    return truth.T_world_camera[0]


@pytest.mark.long
def test_the_difference_of_two_maps_is_the_removed_carton(tables: Service) -> None:
    with Client(tables.url) as robot:
        job = robot.wait(robot.diff("monday", "tuesday")["id"])
    assert job["state"] == "succeeded", job
    found = job["result"]
    assert (found["removed"], found["appeared"], found["moved"]) == (1, 0, 0)
    (carton,) = found["objects"]
    center = _first_pose(BEFORE) @ [*carton["center_m"], 1.0]
    assert np.linalg.norm(center[:3] - [-0.22, 0.05, 0.06]) < 0.05
    assert max(carton["size_m"]) < 0.3
    expected = inverse(_first_pose(BEFORE)) @ _first_pose(AFTER)
    assert np.linalg.norm(np.array(found["T_a_b"]["translation_m"]) - expected[:3, 3]) < 0.02


@pytest.mark.long
def test_a_merge_is_a_new_map_with_the_surface_of_both_and_the_sources_stay(tables: Service) -> None:
    with Client(tables.url) as robot:
        before = [robot.map(name) for name in ("monday", "tuesday")]
        job = robot.wait(robot.merge("monday", "tuesday", "both")["id"])
        assert job["state"] == "succeeded", job
        assert [robot.map(name) for name in ("monday", "tuesday")] == before
        assert job["result"]["gaussians_removed"] > 40
        made, (version,) = robot.map("both"), robot.versions("both")
        assert (made["state"], made["source"], made["gaussians"]) == (
            "ended",
            "monday and tuesday",
            job["result"]["gaussians"],
        )
        assert (version["in_use"], version["keyframes"] > 10) == (True, True)
        T_first_scene = inverse(_first_pose(BEFORE))
        path = tables.client.get("/v1/maps/both/trajectory").json()
        truth = open_log(AFTER).ground_truth
        assert truth is not None
        for T, expected in zip(path["T_world_camera"][30:], truth.T_world_camera, strict=True):
            assert np.linalg.norm(np.array(T)[:3, 3] - (T_first_scene @ expected)[:3, 3]) < 0.01
        again = robot.wait(robot.diff("both", "tuesday")["id"])  # the merged map is compared further
        assert (again["state"], again["result"]["objects"]) == ("succeeded", [])
        robot.delete_map("both")


@pytest.mark.long
def test_a_merge_that_finds_nothing_fails_and_leaves_no_map(tables: Service) -> None:
    with Client(tables.url) as robot:
        elsewhere = "synthetic:corridor?frames=12&rate=6&width=160&height=120"
        robot.wait(robot.create_map("elsewhere", elsewhere)["id"])
        job = robot.wait(robot.merge("monday", "elsewhere", "none")["id"])
        assert (job["state"], job["detail"]) == (
            "failed",
            "overlap: only 0 of 3 keyframes of B are found in A, 3 are needed.",
        )
        with pytest.raises(ServiceError, match="No map"):
            robot.map("none")
        robot.delete_map("elsewhere")


@pytest.mark.long
def test_a_cancelled_merge_leaves_no_map_and_a_taken_name_is_refused(tables: Service) -> None:
    with Client(tables.url) as robot:
        with pytest.raises(ServiceError, match="exists") as caught:
            robot.merge("monday", "tuesday", "tuesday")
        assert caught.value.status == 409
        with pytest.raises(ServiceError, match="same map"):
            robot.merge("monday", "monday", "a", other_version=1)
        job = robot.merge("monday", "tuesday", "gone", key="once")
        assert robot.merge("monday", "tuesday", "gone", key="once")["id"] == job["id"]
        robot.cancel(job["id"])
        assert robot.wait(job["id"])["state"] == "cancelled"
        with pytest.raises(SplatbotError, match="No map"):
            robot.map("gone")
        pinned = tables.runtime.history.versions._pins
        assert sum(pinned.values()) == 0


@pytest.mark.long
def test_maps_that_are_too_large_together_are_refused_before_any_work(tables: Service) -> None:
    settings = tables.runtime.settings
    before = settings.max_merge_gaussians, settings.max_merge_keyframes
    try:
        settings.max_merge_gaussians = 1000
        answer = tables.client.post("/v1/maps/monday/diff", json={"other": "tuesday"})
        assert (answer.status_code, "at most 1000" in answer.json()["detail"]) == (413, True)
        settings.max_merge_gaussians, settings.max_merge_keyframes = before[0], 3
        body = {"other": "tuesday", "version": 1, "other_version": 1}
        assert tables.client.post("/v1/maps/monday/diff", json=body).status_code == 413
    finally:
        settings.max_merge_gaussians, settings.max_merge_keyframes = before

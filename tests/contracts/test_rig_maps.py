"""A rig of recordings under the log roots becomes a map over HTTP, and no other file is read."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import yaml

from splatbot.client import Client
from splatbot.config import CameraConfig
from splatbot.logs.record import record
from splatbot.services.settings import ServiceSettings
from splatbot.workspace import NAME, Workspace
from tests.contracts.conftest import Service, running
from tests.contracts.test_several_cameras import FRAMES, described, table, wrist
from tests.rgbd import small_config
from tests.several_cameras import FramesLog, pose_config
from tests.swept_arm import T_BASE_STATIC_CAMERA, static_log


@pytest.fixture(scope="module")
def places(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Two log roots with recordings of two cameras, and a folder next to them that no client may read."""
    home = tmp_path_factory.mktemp("places")
    T, frames = table()
    record(wrist(), home / "root/wrist")
    record(FramesLog(frames), home / "other/table")
    record(FramesLog(frames), home / "secret/table")
    fixed = described(CameraConfig(T_world_camera=pose_config(T)))
    (home / "root/cell").mkdir()
    write(home / "root/cell/rig.yaml", wrist="../wrist?pair_within=0.01", table=str(home / "other/table"), more=fixed)
    return home


def write(file: Path, *, wrist: str, table: str, more: dict[str, Any], **first: str) -> None:
    cameras = {"wrist": {"log": wrist, **first}, "table": {"log": table, **more}}
    file.write_text(yaml.safe_dump({"cameras": cameras}, sort_keys=False))


@pytest.fixture(scope="module")
def service(places: Path) -> Iterator[Service]:
    with running(ServiceSettings(port=0, log_roots=(str(places / "root"), str(places / "other")))) as service:
        service.runtime.config = small_config()
        yield service


def finished(client: Client, job: dict[str, Any]) -> dict[str, Any]:
    deadline = time.monotonic() + 120
    while (now := client._json("GET", f"/v1/jobs/{job['id']}"))["state"] in ("queued", "running"):
        assert time.monotonic() < deadline
        time.sleep(0.05)
    return now


def test_a_rig_of_recordings_under_two_roots_becomes_one_map(service: Service) -> None:
    with Client(service.url, key=service.key) as client:
        job = client._json("POST", "/v1/maps", {"id": "cell", "log": "cell/rig.yaml"})
        assert finished(client, job)["result"]["frames"] == 2 * FRAMES
        now = client.map("cell")
        assert (now["cameras"]["table"]["kind"], now["cameras"]["table"]["tracked"]) == ("fixed", FRAMES)
        assert now["gaussians"] > 500


def test_each_camera_of_a_rig_masks_the_robot_from_its_own_mount(service: Service, places: Path) -> None:
    log = static_log(0.6)
    for name in ("a", "b"):
        record(log, places / "root" / name)
        Workspace(T_link_camera=T_BASE_STATIC_CAMERA, camera_link=0).save(places / "root" / name / NAME)
    write(
        places / "root/arm.yaml",
        wrist="a",
        table="b",
        more={"T_world_camera": {"translation": [0.0, 0.0, 0.0], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}},
    )
    with Client(service.url, key=service.key) as client:
        body = {"id": "arm", "log": "arm.yaml", "robot": {"name": "panda"}}
        job = finished(client, client._json("POST", "/v1/maps", body))
        assert job["state"] == "succeeded", job
        told = client.map("arm")["robot"]
    assert told == {"name": "panda", "masked": 2 * len(log), "refused": 0, "problem": None}
    moved = service.store.get("arm").workspace
    assert moved is not None
    assert moved.camera_link == 0


BOMB = "a0: &a0 {k: 1}\n" + "".join(f"a{k}: &a{k} {{<<: [*a{k - 1}, *a{k - 1}]}}\n" for k in range(1, 60))
NONE = "is no recording that may be mapped"
REFUSED: dict[str, tuple[str, int, str]] = {
    "a device": ("cameras: {a: {log: 'oak://1'}}", 422, "is a camera, not a recording"),
    "a played log": ("cameras: {a: {log: 'replay:../root/wrist'}}", 422, "is a camera, not a recording"),
    "a synthetic log": ("cameras: {a: {log: 'synthetic:tabletop?frames=2'}}", 422, NONE),
    "a folder outside": ("cameras: {a: {log: ../secret/table}}", 422, NONE),
    "a folder outside by its whole path": ("cameras: {a: {log: SECRET}}", 422, NONE),
    "a folder outside by a link": ("cameras: {a: {log: linked}}", 422, NONE),
    "a list beside cameras in quotes": ('"cameras": {a: {log: wrist}}\nrecordings: [{log: SECRET}]', 422, "is no rig"),
    "a camera file with options": (
        "cameras: {a: {log: wrist, camera: 'huge.json?x'}}",
        422,
        "no camera file that may be",
    ),
    "a number of 5000 digits": (f"cameras: {{a: {{log: wrist, time_offset: 0x{'f' * 5000}}}}}", 422, "digits"),
    "a folder that is not there": ("cameras: {a: {log: ../secret/nothing}}", 422, NONE),
    "a folder of the service": ("cameras: {a: {log: tests}}", 422, NONE),
    "a list that leads out": ("cameras: {a: {log: leaky}}", 422, "leads out of the recording"),
    "itself": ("cameras: {a: {log: bad.yaml}}", 422, NONE),
    "a zero byte": ('cameras: {a: {log: "wrist\\0"}}', 422, NONE),
    "half a character": ('cameras: {a: {log: "wrist\\uD800"}}', 422, ""),
    "a long name": (f"cameras: {{a: {{log: {'a' * 5000}}}}}", 422, NONE),
    "a camera file outside": (
        "cameras: {a: {log: wrist, camera: SECRET/intrinsics.json}}",
        422,
        "no camera file that may be read",
    ),
    "a camera file that is a pipe": ("cameras: {a: {log: wrist, camera: pipe}}", 422, "no camera file that may be"),
    "a huge camera": ("cameras: {a: {log: wrist, camera: huge.json}}", 413, "pixels"),
    "a long file": ("cameras: {a: {log: wrist}}\n" + "#" * 70_000, 413, "more than 65536 bytes"),
    "merged keys that double 60 times": (BOMB + "cameras: {a: {log: wrist}}", 422, "has an alias in line 2"),
    "deep lists": ("cameras: " + "[" * 30_000, 422, "more than 8 levels"),
    "many keys": ("cameras: {" + ", ".join(f"c{k}: 1" for k in range(6000)) + "}", 422, "more than 8"),
    "no YAML": ("cameras: {a: {log: wrist", 422, "is no YAML in line 1"),
    "a day that is not": ("cameras: {a: {log: 2001-99-99}}", 422, "is no YAML file"),
    "no list of cameras": ("recordings: [{log: wrist}]", 422, "is no rig"),
    "nine cameras": ("cameras: {" + ", ".join(f"c{k}: {{log: wrist}}" for k in range(9)) + "}", 422, "more than 8"),
    "an unknown setting": ("cameras: {a: {log: wrist}, b: {log: wrist, T_world_camra: 1}}", 422, "T_world_camra"),
}


def test_a_rig_that_names_something_else_makes_no_map(service: Service, places: Path) -> None:
    root = places / "root"
    (root / "linked").symlink_to(places / "secret/table")
    record(FramesLog(table()[1][:2]), root / "leaky")
    (root / "leaky/rgb.txt").write_text("0.0 ../../secret/table/rgb/000000.png\n1.0 rgb/000001.png\n")
    os.mkfifo(root / "pipe")
    intrinsics = '{"fx": 9e4, "fy": 9e4, "cx": 3e4, "cy": 3e4, "width": 60000, "height": 60000, "depth_scale": 1000}'
    (root / "huge.json").write_text(intrinsics)
    for name, (text, status, why) in REFUSED.items():
        (root / "bad.yaml").write_text(text.replace("SECRET", str(places / "secret/table")))
        began = time.process_time()  # of the service, too; other programs take no part in it
        answer = service.client.post("/v1/maps", json={"id": "bad", "log": "bad.yaml"})
        assert answer.status_code == status, (name, answer.text)
        assert why in answer.text, (name, answer.text)
        assert str(places) not in answer.text, name  # of the server
        assert time.process_time() - began < 5.0, name
    assert "bad" not in {found["id"] for found in service.client.get("/v1/maps").json()["maps"]}


def test_a_rig_elsewhere_or_with_one_camera_for_all_is_refused(service: Service, places: Path) -> None:
    write(places / "secret/rig.yaml", wrist="table", table="table", more={})
    (places / "root/link.yaml").symlink_to(places / "secret/rig.yaml")
    for name in ("link.yaml", "../secret/rig.yaml", str(places / "secret/rig.yaml"), "nothing.yaml"):
        answer = service.client.post("/v1/maps", json={"id": "bad", "log": name})
        assert (answer.status_code, NONE in answer.text) == (422, True), name
    answer = service.client.post("/v1/maps", json={"id": "bad", "log": "cell/rig.yaml", "camera": "tum_fr1"})
    assert answer.status_code == 422
    assert "each recording has its own" in answer.text
    answer = service.client.post("/v1/maps", json={"id": "bad", "log": "cell/rig.yaml", "max_frames": 10**6})
    assert answer.status_code == 202


def test_the_frames_of_all_cameras_count_in_the_limit(places: Path) -> None:
    roots = (str(places / "root"), str(places / "other"))
    with running(ServiceSettings(port=0, log_roots=roots, max_frames=2 * FRAMES - 1)) as service:
        answer = service.client.post("/v1/maps", json={"id": "cell", "log": "cell/rig.yaml"})
        assert answer.status_code == 422
        assert f"has {2 * FRAMES} frames" in answer.text

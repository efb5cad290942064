"""Frames of several cameras, pushed over HTTP, become one map."""

from __future__ import annotations

import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from functools import cache
from pathlib import Path
from threading import Event
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray

from splatbot.cli.serve import _follow_rig
from splatbot.client import Client, ServiceError, TrackedFrame
from splatbot.config import CameraConfig
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.geometry import inverse, look_at, pose_from_quat, rotation_to_quat, se3_exp
from splatbot.logs.record import record
from splatbot.logs.synthetic import SyntheticLog
from splatbot.robots.panda import panda
from splatbot.services.mapping import open_rig
from splatbot.services.robot_mask import RobotMask
from splatbot.services.settings import ServiceSettings
from splatbot.services.topics import FRAME, RESULT, map_topic
from splatbot.tracking.nearby_keyframes import pose_distance
from splatbot.workspace import Workspace
from tests.contracts.conftest import Service, running
from tests.rgbd import small_config
from tests.several_cameras import (
    WRONG,
    FramesLog,
    estimated,
    frames_of,
    in_order,
    in_world,
    pose_config,
    side_view,
    wrist_log,
)
from tests.swept_arm import T_BASE_STATIC_CAMERA, near_the_sweep, static_log

FRAMES = 14


@pytest.fixture(scope="module")
def service() -> Iterator[Service]:
    with running(ServiceSettings(port=0)) as service:
        service.runtime.config = small_config()
        yield service


@pytest.fixture(scope="module")
def client(service: Service) -> Iterator[Client]:
    with Client(service.url, key=service.key) as client:
        yield client


def end(client: Client, *map_ids: str) -> None:
    """End the streams of maps, and wait until they are refined."""
    for map_id in map_ids:
        client.end(map_id)
    until_ended(client, *map_ids)


def until_ended(client: Client, *map_ids: str) -> None:
    deadline = time.monotonic() + 60.0
    while any(client.map(map_id)["state"] != "ended" for map_id in map_ids):
        assert time.monotonic() < deadline
        time.sleep(0.02)


@cache
def wrist() -> SyntheticLog:
    return wrist_log(FRAMES, width=160, height=120)


@cache
def table() -> tuple[NDArray[np.float64], list[Frame]]:
    """Return T_world_camera of a fixed camera, and its frames between those of the first camera."""
    T = side_view(wrist(), np.radians(30), 0.1)
    stamps = [k / 30 + 0.01 for k in range(FRAMES)]
    return in_world(wrist(), T), frames_of(wrist(), [T] * FRAMES, stamps, "table", width=200, height=120)


def described(camera: CameraConfig) -> dict[str, Any]:
    """Return a camera as a request has it."""
    return camera.model_dump(mode="json", exclude_unset=True)


def refused(client: Client, map_id: str, frame: Frame, status: int, match: str) -> None:
    with pytest.raises(ServiceError, match=match) as error:
        client.push(map_id, frame)
    assert error.value.status == status


def test_a_fixed_camera_that_is_wrong_by_2_cm_and_2_degrees_is_found_within_5_mm(
    service: Service, client: Client
) -> None:
    T, frames = table()
    client.create_map("cell", cameras={"table": described(estimated(T @ WRONG, fixed=True))})
    before = client.map("cell")["cameras"]["table"]
    assert (before["kind"], before["frames"], before["reason"], before["pose"]) == ("fixed", 0, None, None)
    results = [client.push("cell", frame) for frame in in_order(wrist(), frames)]
    now = client.map("cell")["cameras"]["table"]
    end(client, "cell")
    path = service.client.get("/v1/maps/cell/trajectory").json()
    assert now["frames"] == FRAMES == now["tracked"] + now["lost"]
    assert now["tracked"] > 0
    assert now["keyframes"] > 0
    assert now["reason"] is None
    found = pose_from_quat(now["pose"]["translation"], now["pose"]["quaternion_wxyz"])
    moved, turned = pose_distance(T, found)
    assert moved < 5e-3
    assert turned < np.radians(0.4)
    assert 0.0 < now["pose"]["translation_sigma"] < 5e-3
    assert 0.0 < now["pose"]["rotation_sigma"] < 5e-3
    own = [r for r, frame in zip(results, in_order(wrist(), frames), strict=True) if frame.camera_name]
    assert own[0].T_world_camera is None
    assert "1 of 8" in own[0].reasons[0]
    assert own[-1].T_world_camera is not None
    np.testing.assert_allclose(own[-1].T_world_camera, found, atol=1e-9)
    assert len(path["stamps"]) == FRAMES  # of the first camera alone


def test_frames_of_a_fixed_camera_may_come_later_than_newer_ones_of_the_first_camera(
    service: Service, client: Client
) -> None:
    T, frames = table()
    exact = described(CameraConfig(T_world_camera=pose_config(T)))
    client.create_map("late", cameras={"table": exact})
    for frame in wrist():
        if frame.index < 6:
            client.push("late", frame)
    for frame in frames[:3]:  # older than the newest one of the first camera
        pose = client.push("late", frame).T_world_camera
        assert pose is not None
        np.testing.assert_allclose(pose, T, atol=1e-9)
    refused(client, "late", frames[2], 422, "is not after")
    assert client.push("late", wrist()[6]).verdict == "ok"
    assert client.map("late")["cameras"]["table"]["tracked"] == 3


def test_a_carried_camera_is_refused_far_from_the_first_one_and_mapped_near_it(
    service: Service, client: Client
) -> None:
    T = se3_exp(np.array([0.05, -0.02, 0.01, 0.1, -0.15, 0.05]))
    poses = [pose @ T for pose in wrist().ground_truth.T_world_camera]
    frames = frames_of(wrist(), poses, wrist().stamps, "side", width=160, height=120)
    client.create_map("arm", cameras={"side": described(CameraConfig(T_first_camera=pose_config(T)))})
    lost = client.push("arm", frames[0])
    assert (lost.verdict, lost.reasons) == ("lost", ["the map has not begun"])
    for k in range(4):
        client.push("arm", wrist()[k])
    refused(client, "arm", frames[1], 409, "the first camera is 0.067 s after it")
    refused(client, "arm", replace(frames[8], stamp=wrist()[3].stamp + 0.15), 409, "is 0.150 s before it")
    refused(client, "arm", frames[7], 422, "is not after")  # the clock of a camera has passed
    client.push("arm", wrist()[9])
    found = client.push("arm", frames[9]).T_world_camera
    assert found is not None
    assert pose_distance(found, in_world(wrist(), poses[9]))[0] < 5e-3
    assert client.map("arm")["cameras"]["side"]["kind"] == "carried"
    assert client.map("arm")["cameras"]["side"]["frames"] == 2  # refused ones do not count


def test_two_clients_that_push_a_camera_each_get_the_right_pose_or_a_refusal(client: Client) -> None:
    T = se3_exp(np.array([0.05, -0.02, 0.01, 0.1, -0.15, 0.05]))
    poses = [pose @ T for pose in wrist().ground_truth.T_world_camera]
    frames = frames_of(wrist(), poses, wrist().stamps, "side", width=160, height=120)
    client.create_map("both", cameras={"side": described(CameraConfig(T_first_camera=pose_config(T)))})
    mapped = [Event() for _ in frames]

    def push_first() -> None:
        for frame, done in zip(wrist(), mapped, strict=True):
            assert client.push("both", frame).verdict == "ok"
            done.set()

    def push_side() -> dict[int, TrackedFrame]:
        found = {}
        for k, frame in enumerate(frames[1:], 1):
            assert mapped[k - 1].wait(30)  # a camera takes its images at their time, not before
            try:
                found[k] = client.push("both", frame)
            except ServiceError as error:
                assert error.status == 409  # noqa: PT017 - other errors are raised
        return found

    with ThreadPoolExecutor(2) as threads:
        first, side = threads.submit(push_first), threads.submit(push_side)
        first.result()
        found = side.result()
    assert found
    for k, result in found.items():
        assert result.T_world_camera is not None
        assert pose_distance(result.T_world_camera, in_world(wrist(), poses[k]))[0] < 4e-3


def test_a_frame_of_an_unknown_camera_or_of_another_size_is_refused_alone(service: Service, client: Client) -> None:
    T, frames = table()
    client.create_map("sizes", cameras={"table": described(CameraConfig(T_world_camera=pose_config(T)))})
    client.create_map("one")
    client.push("sizes", wrist()[0])
    client.push("sizes", frames[0])
    refused(client, "sizes", replace(frames[1], camera_name="shelf"), 422, "is 'shelf'")
    refused(client, "one", frames[1], 422, "further cameras are none|is 'table'")
    damaged = {"stamp": 1.0, "camera_name": "shelf", "rgb": "AAAA", "depth": "AAAA"}
    damaged["camera"] = {n: getattr(wrist().camera, n) for n in ("fx", "fy", "cx", "cy", "width", "height")}
    answer = service.client.post("/v1/maps/sizes/frames", json=damaged)
    assert (answer.status_code, answer.json()["field"]) == (422, "camera_name")  # before its images are looked at
    small = frames_of(wrist(), [np.eye(4)], [0.2], "table", width=80, height=60)[0]
    refused(client, "sizes", small, 422, "80 x 60, frames before are 200 x 120")
    assert client.push("sizes", wrist()[1]).verdict == "ok"
    assert client.push("sizes", frames[1]).verdict == "ok"


POSE = {"translation": [0.5, 0.0, 0.4], "quaternion_wxyz": [1.0, 0.0, 0.0, 0.0]}


@pytest.mark.parametrize(
    ("more", "message"),
    [
        ({"cameras": {"a b": {}}}, "cameras"),
        ({"cameras": {"n" * 33: {}}}, "cameras"),
        ({"cameras": {f"c{k}": {} for k in range(8)}}, "cameras"),
        ({"cameras": {"table": {"T_world_camera": POSE, "T_first_camera": POSE}}}, "not both"),
        ({"cameras": {"table": {"translation_sigma": 0.02, "rotation_sigma": 0.02}}}, "needs a pose"),
        ({"cameras": {"table": {"T_world_camera": POSE, "translation_sigma": 0.5}}}, "cameras.table.translation_sigma"),
        ({"cameras": {"table": {"T_world_camera": POSE, "translation_sigma": 0.02}}}, "both standard deviations"),
        ({"cameras": {"table": {"sensor": {"max_depht": 3.0}}}}, "cameras.table.sensor.max_depht"),
        ({"cameras": {"table": {"sensor": {"max_depth": float("inf")}}}}, "finite"),
        ({"cameras": {"table": {"T_world_camera": POSE | {"quaternion_wxyz": [0, 0, 0, 0]}}}}, "quaternion"),
        ({"cameras": {"table": {"robot": {"T_link_camera": POSE}}}}, "cameras.table.robot"),
        ({"cameras": {"table": {}}, "log": "synthetic:tabletop?frames=2"}, "pushed frames"),
    ],
)
def test_cameras_that_make_no_sense_make_no_map(more: dict[str, Any], message: str, client: Client) -> None:
    with pytest.raises(ServiceError, match=message) as error:
        client.create_map("none", **more)
    assert error.value.status == 422
    assert "none" not in {described["id"] for described in client.maps()}


T_BASE_OTHER_CAMERA = look_at(np.array([1.1, 0.5, 0.7]), np.array([0.4, 0.0, 0.15]))


def mount(T: NDArray[np.float64]) -> dict[str, Any]:
    pose = {"translation": T[:3, 3].tolist(), "quaternion_wxyz": rotation_to_quat(T[:3, :3]).tolist()}
    return {"T_link_camera": pose, "camera_link": 0}


def test_a_moving_arm_in_view_of_two_cameras_is_in_the_map_of_neither(service: Service, client: Client) -> None:
    log = static_log(3.0)
    T = inverse(T_BASE_STATIC_CAMERA) @ T_BASE_OTHER_CAMERA
    fixed = described(CameraConfig(T_world_camera=pose_config(T)))
    other = [
        replace(
            frames_of(log, [log.T_scene_base @ T_BASE_OTHER_CAMERA], [f.stamp], "other", width=160, height=120)[0],  # type: ignore[arg-type]
            joints=f.joints,
        )
        for f in log
    ]
    robot = {"name": "panda", **mount(T_BASE_STATIC_CAMERA)}
    client.create_map("masked", robot=robot, cameras={"other": fixed | {"robot": mount(T_BASE_OTHER_CAMERA)}})
    client.create_map("bare", cameras={"other": fixed})
    for frame in in_order(log, other):
        for map_id in ("masked", "bare"):
            client.push(map_id, frame)
    end(client, "masked", "bare")
    seen = {m: client.map(m)["cameras"]["other"]["keyframes"] for m in ("masked", "bare")}
    means = {m: service.store.get(m).ready.model.means.numpy() for m in ("masked", "bare")}
    robot_now = client.map("masked")["robot"]
    counts = {m: near_the_sweep(means[m], T_BASE_STATIC_CAMERA, log.joints) for m in means}
    assert min(seen.values()) > 0
    assert counts["masked"] == 0
    assert counts["bare"] > 100
    assert robot_now == {"name": "panda", "masked": 2 * len(log), "refused": 0, "problem": None}


def test_a_camera_without_a_mount_in_a_map_with_a_robot_is_refused_with_the_reason(
    service: Service, client: Client
) -> None:
    log = static_log(1.0)
    T, _ = table()
    robot = {"name": "panda", **mount(T_BASE_STATIC_CAMERA)}
    client.create_map(
        "no-mount", robot=robot, cameras={"table": described(CameraConfig(T_world_camera=pose_config(T)))}
    )
    client.push("no-mount", log[0])
    own = replace(log[1], camera_name="table")
    refused(client, "no-mount", own, 409, "mount of camera table is not known")
    client.push("no-mount", log[1])
    now = client.map("no-mount")
    assert "mount of camera table" in now["cameras"]["table"]["reason"]
    assert now["cameras"]["table"]["frames"] == 0
    assert now["robot"]["refused"] == 1


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    """A rig of a moving camera and a fixed one."""
    T, frames = table()
    record(wrist(), tmp_path / "wrist", ground_truth=wrist().ground_truth)
    record(FramesLog(frames), tmp_path / "table")
    fixed = described(CameraConfig(T_world_camera=pose_config(T)))
    cameras = {"wrist": {"log": "wrist"}, "table": {"log": "table", **fixed}}
    (tmp_path / "rig.yaml").write_text(yaml.safe_dump({"cameras": cameras}, sort_keys=False))
    return tmp_path / "rig.yaml"


def test_the_recordings_of_a_rig_are_served_and_views_show_the_first_camera(
    rig: Path, service: Service, client: Client
) -> None:
    with service.store.bus.subscribe("maps/*", capacity=1000, latched=False) as reader:
        _follow_rig(service.runtime, str(rig), None)
        until_ended(client, "default")
        seen: dict[str, list[int]] = {}
        while (message := reader.get(0)) is not None:
            seen.setdefault(message.topic, []).append(getattr(message.value, "index", 0))
    now = client.map("default")["cameras"]["table"]
    assert (now["kind"], now["frames"], now["tracked"]) == ("fixed", FRAMES, FRAMES)
    assert seen[map_topic("default", FRAME)] == [*range(0, 2 * FRAMES, 2)]
    assert seen[map_topic("default", RESULT)] == [*range(0, 2 * FRAMES, 2)]
    path = service.client.get("/v1/maps/default/trajectory").json()
    assert len(path["stamps"]) == FRAMES
    metrics = service.client.get("/metrics").text
    assert f'splatbot_frames_total{{map="default",verdict="ok"}} {2 * FRAMES}.0' in metrics
    with pytest.raises(InputError, match="each camera has its own"):
        _follow_rig(service.runtime, str(rig), "tum_fr1")


def test_recordings_of_a_rig_have_the_mounts_and_delays_of_their_own_folders(rig: Path) -> None:
    Workspace(T_link_camera=T_BASE_STATIC_CAMERA, camera_link=0, joint_delay=0.2).save(rig.parent / "wrist/scene.yaml")
    log, workspaces = open_rig(str(rig))
    assert set(log.cameras) == {"table"}
    assert workspaces.keys() == {""}  # the other one has no mount
    Workspace(T_link_camera=T_BASE_OTHER_CAMERA, camera_link=0).save(rig.parent / "table/scene.yaml")
    _, workspaces = open_rig(str(rig))
    assert workspaces[""].joint_delay == 0.2
    mask = RobotMask(panda(), workspaces.pop(""), further=workspaces)
    frame = replace(static_log(1.0)[0], camera_name="table")
    assert mask(frame, live=False).mask is not None

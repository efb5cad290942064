"""An arm that sweeps in view of a live camera never becomes part of the map."""

from __future__ import annotations

import base64
import itertools
import json
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from websockets.sync.client import connect

from splatbot.client import Client, ServiceError
from splatbot.geometry import rotation_to_quat
from splatbot.logs.record import record
from splatbot.robots.panda import panda
from splatbot.services.settings import ServiceSettings
from splatbot.sim.wrist import WristLog
from splatbot.workspace import Workspace
from tests.contracts.conftest import Service, running
from tests.swept_arm import T_BASE_STATIC_CAMERA, near_the_sweep, static_log, sweep

STATIC = {
    "name": "panda",
    "camera_link": 0,
    "T_link_camera": {
        "translation": T_BASE_STATIC_CAMERA[:3, 3].tolist(),
        "quaternion_wxyz": rotation_to_quat(T_BASE_STATIC_CAMERA[:3, :3]).tolist(),
    },
}
SCENE = Workspace(T_link_camera=T_BASE_STATIC_CAMERA, camera_link=0)
NAMES = panda().chain.names
STATES_HZ = 50.0
LATE = 0.4  # [s]; within 0.1 s, the margins of mask and spheres hide the delay


@contextmanager
def serving(**settings: Any) -> Iterator[Service]:
    with running(ServiceSettings(port=0, **settings)) as service:
        yield service


def client_of(service: Service) -> Client:
    return Client(service.url, key=service.key)


def near(service: Service, map_id: str, log: WristLog) -> int:
    """Count the Gaussians of a served map within 2 cm of the swept arm; the map's world is the static camera."""
    model = service.store.get(map_id).ready.model
    assert len(model) > 500
    return near_the_sweep(model.means.numpy(), T_BASE_STATIC_CAMERA, log.joints[:: max(1, len(log) // 60)])


def until(condition: Callable[[], Any], seconds: float = 120.0) -> None:
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.02)


def push_all(client: Client, map_id: str, log: WristLog, *, delay: float = 0.0) -> None:
    """Push frames without joints, each after the joint states around it, whose stamps are late."""
    for frame in log:
        times = frame.stamp + np.arange(-24, 8) / STATES_HZ
        client.report_joints("panda", times + delay, sweep(times), names=NAMES)
        client.push(map_id, replace(frame, joints=None))
    client.end(map_id)


def check_http(seconds: float) -> None:
    log = static_log(seconds)
    with serving() as service:
        client = client_of(service)
        client.create_map("masked", robot=STATIC)
        push_all(client, "masked", log)
        for map_id, known in (("late", LATE), ("unknown", 0.0)):
            client.create_map(map_id, robot=STATIC | {"joint_delay": known})
            push_all(client, map_id, log, delay=LATE)
        client.create_map("own", robot=STATIC)
        client.create_map("bare")
        for map_id in ("own", "bare"):  # frames with joints of their own
            for frame in itertools.islice(log, 60):
                client.push(map_id, frame)
            client.end(map_id)
        until(lambda: all(m["state"] == "ended" for m in client.maps()))
        counts = {m["id"]: near(service, m["id"], log) for m in client.maps()}
        described = {m["id"]: m["robot"] for m in client.maps()}
    assert [counts[name] for name in ("masked", "late", "own")] == [0, 0, 0]
    assert counts["bare"] > 100
    assert counts["unknown"] > 0
    assert described["bare"] is None
    assert described["late"] == {"name": "panda", "masked": len(log), "refused": 0, "problem": None}


def check_ros(seconds: float, scene: Path) -> None:
    """Publish images, intrinsics and joint states by rosbridge, as a camera driver and a robot driver do."""
    log = static_log(seconds)
    SCENE.save(scene)
    with serving(robot="panda", scene=scene) as service, connect(service.ws("/rosbridge")) as socket:
        client = client_of(service)

        def publish(topic: str, kind: str, message: dict[str, Any]) -> None:
            socket.send(json.dumps({"op": "publish", "topic": topic, "type": kind, "msg": message}))

        def header(stamp: float) -> dict[str, Any]:
            return {"stamp": dict(zip(("sec", "nanosec"), divmod(round(stamp * 1e9), 10**9), strict=True))}

        k = log.camera.K
        order = [6, 3, 0, 5, 2, 4, 1]  # drivers sort names as they like
        for frame in log:
            for t in frame.stamp + np.arange(-2, 8) / STATES_HZ + 1.0:
                q = sweep(np.array([t - 1.0]))[0]
                message = {"header": header(t), "name": [NAMES[i] for i in order], "position": q[order].tolist()}
                publish("/joint_states", "sensor_msgs/JointState", message)
                finger = {"header": header(t), "name": ["panda_finger_joint1"], "position": [0.04]}
                publish("/joint_states", "sensor_msgs/JointState", finger)
            at = header(frame.stamp + 1.0)
            size = {"height": log.camera.height, "width": log.camera.width, "header": at}
            info = size | {"k": k.ravel().tolist(), "d": [0.0] * 5, "distortion_model": "plumb_bob"}
            publish("/camera/color/camera_info", "sensor_msgs/CameraInfo", info)
            for topic, image, encoding in (
                ("/camera/depth/image_raw", frame.depth, "32FC1"),
                ("/camera/color/image_raw", frame.rgb, "rgb8"),
            ):
                publish(topic, "sensor_msgs/Image", size | {"encoding": encoding} | _data(image))
            until(lambda: _frames_of(client) > frame.index)  # noqa: B023 - called at once
        client.end("ros")
        until(lambda: client.map("ros")["state"] == "ended")
        told = client.map("ros")["robot"]
        assert told == {"name": "panda", "masked": len(log), "refused": 0, "problem": None}
        assert near(service, "ros", log) == 0


def _data(image: NDArray[Any]) -> dict[str, Any]:
    return {"step": image.strides[0], "data": base64.b64encode(image.tobytes()).decode(), "is_bigendian": 0}


def _frames_of(client: Client) -> int:
    told = next((m["robot"] for m in client.maps() if m["id"] == "ros"), {"masked": 0, "refused": 0})
    return int(told["masked"] + told["refused"])


def check_log(seconds: float, folder: Path) -> None:
    log = static_log(seconds)
    recorded = record(log, folder / "static", ground_truth=log.ground_truth)
    SCENE.save(recorded / "scene.yaml")
    with serving(log_roots=(str(folder),)) as service:
        client = client_of(service)
        client.wait(client.create_map("masked", "static", robot={"name": "panda"})["id"])
        client.wait(client.create_map("bare", "static")["id"])
        counts = {m["id"]: near(service, m["id"], log) for m in client.maps()}
        assert client.map("masked")["robot"]["masked"] == len(log)
    assert counts["masked"] == 0
    assert counts["bare"] > 100


@pytest.mark.long
def test_the_arm_stays_out_of_a_map_of_pushed_frames_with_late_joint_states_too() -> None:
    check_http(3.0)


def test_the_arm_stays_out_of_a_map_of_ros_topics(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatbot.services.robot_mask._WAIT_S", 30.0)  # a busy machine reads the queue of joints later
    check_ros(3.0, tmp_path / "scene.yaml")


@pytest.mark.long
def test_the_arm_stays_out_of_a_recording_that_a_client_names(tmp_path: Path) -> None:
    check_log(3.0, tmp_path)


@pytest.mark.long
def test_an_arm_that_sweeps_for_a_minute_stays_out_of_the_map_by_http_ros_and_log(tmp_path: Path) -> None:
    check_http(60.0)
    check_ros(60.0, tmp_path / "scene.yaml")
    check_log(60.0, tmp_path)


def test_a_frame_without_joint_states_is_refused_and_the_next_one_with_them_is_mapped() -> None:
    log = static_log(1.0)
    with serving() as service:
        client = client_of(service)
        client.create_map("robot", robot=STATIC)
        with pytest.raises(ServiceError, match="missing or stale") as stale:
            client.push("robot", replace(log[0], joints=None))
        assert stale.value.status == 409
        told = client.map("robot")["robot"]
        assert (told["masked"], told["refused"]) == (0, 1)
        assert "missing or stale" in told["problem"]
        times = log[1].stamp + np.arange(-2, 3) / STATES_HZ
        assert client.report_joints("panda", times, sweep(times)) == 1
        client.push("robot", replace(log[1], joints=None))
        told = client.map("robot")["robot"]
        assert told == {"name": "panda", "masked": 1, "refused": 1, "problem": None}
        client.hold("robot", [[0.0, 0.0, 0.15, 0.05]])
        client.create_map("bare")
        with pytest.raises(ServiceError, match="no robot is masked") as none:
            client.hold("bare", [])
        assert none.value.status == 409


@pytest.mark.parametrize(
    ("robot", "message"),
    [
        ({"name": "panda"}, "T_link_camera"),
        ({"name": "r2d2"}, "r2d2"),
        (STATIC | {"camera_link": 99}, "link"),
        (STATIC | {"joint_offsets": [0.1]}, "joint_offsets"),
        (STATIC | {"joint_names": ["a"]}, "joint_names"),
        (STATIC | {"joint_delay": 2.0}, "joint_delay"),
    ],
)
def test_a_robot_that_cannot_be_masked_makes_no_map(robot: dict[str, Any], message: str) -> None:
    with serving() as service:
        client = client_of(service)
        with pytest.raises(ServiceError, match=message) as error:
            client.create_map("robot", robot=robot)
        assert error.value.status == 422
        assert client.maps() == []


def test_a_pushed_frame_whose_depth_is_later_needs_the_joints_at_both_times() -> None:
    log = static_log(0.6)
    late = replace(log[0], depth=log[1].depth, depth_delay=0.1)
    with serving() as service:
        client = client_of(service)
        client.create_map("late", robot=STATIC)
        with pytest.raises(ServiceError, match="missing or stale") as refused:
            client.push("late", late)
        assert refused.value.status == 409
        client.push("late", replace(log[1], depth=log[2].depth, depth_delay=0.1, depth_joints=log.joints[2]))
        assert client.map("late")["robot"]["masked"] == 1
        client.end("late")

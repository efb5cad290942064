"""An arm in view of a ROS camera never becomes part of the map where only its TF is published."""

from __future__ import annotations

import base64
import json
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from splatbot.cli.serve import _follow_log
from splatbot.client import Client, ServiceError
from splatbot.frame import Frame
from splatbot.geometry import inverse, rotation_to_quat
from splatbot.mapping.selfmask import SelfMask
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from splatbot.services.settings import ServiceSettings
from splatbot.sim.wrist import WristLog
from tests.contracts.conftest import Service, running
from tests.ros_recording import record_ros
from tests.swept_arm import T_BASE_STATIC_CAMERA, near_the_sweep, static_log, sweep
from tests.waiting import until

HZ = 50.0
START = 1.7e9  # [s]


@dataclass
class Robot:
    """A driver of a camera and an arm at a rosbridge, whose clock begins at ``START``."""

    socket: Connection
    client: Client

    def publish(self, topic: str, kind: str, message: dict[str, Any]) -> None:
        self.socket.send(json.dumps({"op": "publish", "topic": topic, "type": kind, "msg": message}))

    def transforms(self, topic: str, stamp: float, *edges: tuple[str, str, Array]) -> None:
        listed = [
            {
                "header": header(stamp, parent),
                "child_frame_id": child,
                "transform": {
                    "translation": dict(zip("xyz", T[:3, 3].tolist(), strict=True)),
                    "rotation": dict(zip("wxyz", rotation_to_quat(T[:3, :3]).tolist(), strict=True)),
                },
            }
            for parent, child, T in edges
        ]
        self.publish(topic, "tf2_msgs/TFMessage", {"transforms": listed})

    def arm(self, stamp: float) -> None:
        T = panda().fk(sweep(np.array([stamp - START]))[0])
        edges = [(f"panda_link{k}", f"panda_link{k + 1}", inverse(T[k]) @ T[k + 1]) for k in range(7)]
        self.transforms("/tf", stamp, *edges)

    def images(self, frame: Frame, camera_frame: str = "optical") -> None:
        at = header(START + frame.stamp, camera_frame)
        size = {"height": frame.camera.height, "width": frame.camera.width, "header": at}
        info = size | {"k": frame.camera.K.ravel().tolist(), "d": [0.0] * 5, "distortion_model": "plumb_bob"}
        self.publish("/camera/color/camera_info", "sensor_msgs/CameraInfo", info)
        for topic, image, encoding in (
            ("/camera/depth/image_raw", frame.depth, "32FC1"),
            ("/camera/color/image_raw", frame.rgb, "rgb8"),
        ):
            self.publish(topic, "sensor_msgs/Image", size | {"encoding": encoding} | data_of(image))

    def counts(self) -> tuple[int, int]:
        """Return the numbers of masked and of refused frames."""
        robot = next((m["robot"] for m in self.client.maps() if m["id"] == "ros"), {"masked": 0, "refused": 0})
        return int(robot["masked"]), int(robot["refused"])

    def send(self, frame: Frame, *, arm: bool = True) -> None:
        """Publish a frame after the transforms around it, and wait until it is masked or refused."""
        before = sum(self.counts())
        for t in frame.stamp + np.arange(-2, 8) / HZ:
            if arm:
                self.arm(START + t)
        self.images(frame)
        until(lambda: sum(self.counts()) > before)


def header(stamp: float, frame: str) -> dict[str, Any]:
    return {"stamp": dict(zip(("sec", "nanosec"), divmod(round(stamp * 1e9), 10**9), strict=True)), "frame_id": frame}


def data_of(image: NDArray[Any]) -> dict[str, Any]:
    return {"step": image.strides[0], "data": base64.b64encode(image.tobytes()).decode(), "is_bigendian": 0}


@pytest.fixture
def patient(monkeypatch: pytest.MonkeyPatch) -> None:
    """Has frames wait for joints and TF as long as a busy machine needs, on which they are in the queues already."""
    monkeypatch.setattr("splatbot.services.robot_mask._WAIT_S", 30.0)


@contextmanager
def driving(**settings: Any) -> Iterator[tuple[Service, Robot]]:
    """Serve the robot of a driver whose camera is on a table, in which the arm stands."""
    with running(ServiceSettings(port=0, **settings)) as service, connect(service.ws("/rosbridge")) as socket:
        robot = Robot(socket, Client(service.url, key=service.key))
        T_table_base = np.eye(4)
        T_table_base[:3, 3] = 0.3, -0.2, 0.1
        edges = ("table", "panda_link0", T_table_base), ("table", "optical", T_table_base @ T_BASE_STATIC_CAMERA)
        robot.transforms("/tf_static", START, *edges)
        yield service, robot


def near(service: Service, log: WristLog) -> int:
    """Count the Gaussians of the map within 2 cm of the swept arm; the world of the map is the static camera."""
    model = service.store.get("ros").ready.model
    assert len(model) > 500
    return near_the_sweep(model.means.numpy(), T_BASE_STATIC_CAMERA, log.joints[:: max(1, len(log) // 60)])


def finished(robot: Robot) -> Callable[[], bool]:
    robot.client.end("ros")
    return lambda: bool(robot.client.map("ros")["state"] == "ended")


def check_tf(seconds: float) -> None:
    log = static_log(seconds)
    with driving(robot="panda") as (service, robot):
        for frame in log:
            robot.send(frame)
        until(finished(robot))
        described = robot.client.map("ros")["robot"]
        assert described == {"name": "panda", "masked": len(log), "refused": 0, "problem": None}
        assert near(service, log) == 0


@pytest.mark.usefixtures("patient")
def test_the_arm_stays_out_of_a_map_where_only_tf_is_published() -> None:
    check_tf(2.0)


def test_depth_of_another_camera_is_mapped_at_its_own_pixels_once_its_tf_has_come(
    caplog: pytest.LogCaptureFixture,
) -> None:
    frame = static_log(1.0)[0]
    camera = frame.camera
    wide = np.repeat(np.repeat(frame.rgb, 2, axis=0), 2, axis=1)  # as of a colour camera with twice the pixels
    info = {"distortion_model": "plumb_bob", "d": [0.0] * 5}
    with driving() as (service, robot):
        frames = service.store.bus.subscribe("maps/ros/frame", capacity=16, latched=False)

        def publish(stamp: float) -> None:
            for topic, of, image, encoding, name in (
                ("color", camera.resized(320, 240), wide, "rgb8", "color_optical"),
                ("depth", camera, frame.depth, "32FC1", "depth_optical"),
            ):
                size = {"height": of.height, "width": of.width, "header": header(START + stamp, name)}
                about = size | info | {"k": of.K.ravel().tolist()}
                robot.publish(f"/camera/{topic}/camera_info", "sensor_msgs/CameraInfo", about)
                message = size | {"encoding": encoding} | data_of(image)
                robot.publish(f"/camera/{topic}/image_raw", "sensor_msgs/Image", message)

        publish(0.0)
        until(lambda: "TF does not connect them" in caplog.text)
        robot.transforms("/tf_static", START, ("color_optical", "depth_optical", np.eye(4)))
        until(lambda: service.runtime.find_transform("color_optical", "depth_optical") is not None)
        publish(1.0)
        first = frames.get(60.0)
        assert first is not None
        assert first.value.stamp == START + 1.0
        assert first.value.camera == camera
        assert first.value.camera_frame == "depth_optical"
        np.testing.assert_array_equal(first.value.depth, frame.depth)
        np.testing.assert_allclose(first.value.rgb.astype(float), frame.rgb, atol=1.0)
        frames.close()


@pytest.mark.long
def test_the_arm_stays_out_of_a_recording_with_tf_alone_that_a_client_or_the_command_names(tmp_path: Path) -> None:
    log = static_log(1.4)
    bag = record_ros(tmp_path / "tf", log)
    record_ros(tmp_path / "short", log, tf_until=0.9)
    with running(ServiceSettings(port=0, robot="panda", log_roots=(str(tmp_path),))) as service:
        client = Client(service.url, key=service.key)
        _follow_log(service.runtime, str(bag), None)
        for name in ("tf", "short"):
            client.wait(client.create_map(name, name, robot={"name": "panda"})["id"])
        until(lambda: client.map("default")["state"] == "ended")
        for name, masked in (("default", 7), ("tf", 7), ("short", 5)):
            model = service.store.get(name).ready.model
            assert len(model) > 500
            assert near_the_sweep(model.means.numpy(), T_BASE_STATIC_CAMERA, log.joints) == 0
            described = client.map(name)["robot"]
            assert (described["masked"], described["refused"]) == (masked, len(log) - masked)
        assert "missing or stale" in client.map("short")["robot"]["problem"]


def test_without_the_mask_the_same_frames_put_the_arm_into_the_map() -> None:
    log = static_log(2.0)
    with driving() as (service, robot):
        results = service.store.bus.subscribe("maps/ros/result", capacity=16, latched=False)
        for frame in log:
            robot.images(frame)
            assert results.get(60.0) is not None
        until(finished(robot))
        assert near(service, log) > 100


@pytest.mark.long
@pytest.mark.usefixtures("patient")
def test_an_arm_that_sweeps_for_a_minute_stays_out_of_the_map_by_tf_alone() -> None:
    check_tf(60.0)


@pytest.mark.usefixtures("patient")
def test_frames_are_refused_while_tf_has_stopped_and_mapped_when_it_goes_on(monkeypatch: pytest.MonkeyPatch) -> None:
    log = static_log(2.0)
    with driving(robot="panda") as (_, robot):
        robot.send(log[0])
        with monkeypatch.context() as impatient:
            impatient.setattr("splatbot.services.robot_mask._WAIT_S", 0.15)
            for frame in (log[3], log[4]):
                robot.send(frame, arm=False)
        assert robot.counts() == (1, 2)
        assert "TF of panda_link1" in robot.client.map("ros")["robot"]["problem"]
        robot.send(log[6])
        assert robot.counts() == (2, 2)
        assert robot.client.map("ros")["robot"]["problem"] is None


def test_a_map_for_ros_topics_masks_a_robot_whose_camera_only_tf_places() -> None:
    log = static_log(1.0)
    with driving() as (_, robot):
        robot.client.create_map("ros", robot={"name": "panda"})
        with pytest.raises(ServiceError, match="name no frame of their camera") as pushed:
            robot.client.push("ros", replace(log[0], stamp=START + log[0].stamp, joints=None))
        assert pushed.value.status == 409
        robot.send(log[1])
        assert robot.counts() == (1, 1)
        with pytest.raises(ServiceError, match="T_link_camera") as other:
            robot.client.create_map("pushed", robot={"name": "panda"})
        assert other.value.status == 422


def test_the_links_of_a_robot_have_the_prefix_that_the_map_was_made_with() -> None:
    log = static_log(1.0)
    with driving() as (_, robot):
        robot.client.create_map("ros", robot={"name": "panda", "tf_prefix": "left_"})
        robot.send(log[1])
        problem = robot.client.map("ros")["robot"]["problem"]
        assert "TF has no frame left_panda_link0, left_panda_link1" in problem


@pytest.mark.usefixtures("patient")
def test_an_object_that_moveit_attaches_is_masked_until_it_is_detached() -> None:
    log = static_log(2.0)
    with driving(robot="panda") as (service, robot):
        hidden: list[int] = []
        news = service.store.bus.subscribe("maps/ros/frame", capacity=16, latched=False)

        def send(index: int) -> None:
            robot.send(log[index])
            message = news.get(10.0)
            assert message is not None
            hidden.append(int((~message.value.mask).sum()))

        below = np.eye(4)
        below[2, 3] = 0.107
        robot.transforms("/tf_static", START, ("panda_link7", "panda_hand", below))
        send(0)
        solid = {"type": 3, "dimensions": [0.3, 0.08]}
        box = {"id": "can", "primitives": [solid], "primitive_poses": [{"position": {"z": 0.25}}], "operation": 0}
        attached = {"link_name": "panda_hand", "object": box}
        robot.publish("/attached_collision_object", "moveit_msgs/AttachedCollisionObject", attached)
        send(1)
        gone = {"link_name": "panda_hand", "object": {"id": "can", "operation": 1}}
        scene = {"is_diff": True, "robot_state": {"is_diff": True, "attached_collision_objects": [gone]}}
        robot.publish("/monitored_planning_scene", "moveit_msgs/PlanningScene", scene)
        send(2)
        plain = SelfMask(panda(), T_BASE_STATIC_CAMERA, link=0)
        more = [found - int((~plain.usable(log[index])).sum()) for index, found in enumerate(hidden)]
        assert abs(more[0]) < 60
        assert more[1] > 300
        assert abs(more[2]) < 60

"""ROS 2 nodes over Zenoh, played by eclipse-zenoh itself: keys, tokens and bytes as rmw_zenoh has them."""

from __future__ import annotations

import socket
import time
from collections.abc import Iterator
from contextlib import suppress
from typing import Any

import numpy as np
import pytest

from splatbot.camera import Camera
from splatbot.errors import ConfigError
from splatbot.frame import Frame
from splatbot.logs.ros_frames import camera_info_message, image_message
from splatbot.logs.ros_types import build, from_cdr, to_cdr, type_of, typestore
from splatbot.services.ros.messages import points_of
from splatbot.services.ros.node import RosNode
from splatbot.services.ros.publishers import POINTS
from splatbot.services.ros.zenoh_bridge import ZenohBridge
from splatbot.services.store import MapStore
from splatbot.services.topics import ROS_ROBOT
from tests.contracts.conftest import wall
from tests.waiting import until

zenoh = pytest.importorskip("zenoh")

CAMERA = Camera(40.0, 40.0, 23.5, 17.5, 48, 36)
CLOUD = "sensor_msgs::msg::dds_::PointCloud2_"


@pytest.fixture
def router() -> Iterator[tuple[str, Any]]:
    """An address, and a session that listens there."""
    for _ in range(5):  # another process may take the port first
        with socket.create_server(("127.0.0.1", 0)) as probe:
            address = f"tcp/127.0.0.1:{probe.getsockname()[1]}"
        config = zenoh.Config.from_json5(
            f'{{mode: "router", listen: {{endpoints: ["{address}"]}}, scouting: {{multicast: {{enabled: false}}}}}}'
        )
        with suppress(zenoh.ZError):
            session = zenoh.open(config)
            break
    else:
        pytest.fail("no free port was found")
    with session:
        yield address, session


@pytest.fixture
def frames() -> list[Frame]:
    return []


@pytest.fixture
def node(router: tuple[str, Any], frames: list[Frame]) -> Iterator[RosNode]:
    store = MapStore()
    node = RosNode(store, on_frame=frames.append)
    node.start()
    bridge = ZenohBridge(node.graph, router[0], domain=7)
    store.add("wall", source="a", state="static", snapshot=wall())
    bridge.start()
    yield node
    bridge.stop()
    node.stop()


def test_the_cloud_arrives_under_its_key_with_number_and_time_also_late(router: tuple[str, Any], node: RosNode) -> None:
    from zenoh import ext

    until(lambda: node.graph.latched(POINTS) is not None)
    got: list[Any] = []
    key = f"7{POINTS}/{CLOUD}/{typestore().hash_rihs01('sensor_msgs/msg/PointCloud2')}"
    reader = ext.declare_advanced_subscriber(
        router[1], key, got.append, history=ext.HistoryConfig(detect_late_publishers=True)
    )
    until(lambda: bool(got))
    cloud = from_cdr(bytes(got[0].payload), "sensor_msgs/msg/PointCloud2")
    np.testing.assert_array_equal(points_of(cloud)["x"], wall().model.means[:, 0].numpy())
    number, stamp, gid = ext.z_deserialize(tuple[ext.Int64, ext.Int64, bytes], got[0].attachment)
    assert number >= 1
    assert abs(stamp / 1e9 - time.time()) < 60
    assert len(gid) == 16
    reader.undeclare()


def test_the_node_and_its_topics_are_listed(router: tuple[str, Any], node: RosNode) -> None:
    def listed() -> list[str]:
        return [str(reply.ok.key_expr) for reply in router[1].liveliness().get("@ros2_lv/7/**") if reply.ok]

    until(lambda: any("%map%points" in key for key in listed()))
    assert sum("/NN/%/%/splatbot" in key for key in listed()) == 1
    (cloud,) = (key for key in listed() if "/%map%points/" in key)
    assert cloud.split("/")[5:] == [
        "MP", "%", "%", "splatbot", "%map%points", CLOUD, typestore().hash_rihs01("sensor_msgs/msg/PointCloud2"),
        ":1:,1:,:,:,,",
    ]  # fmt: skip


def test_images_of_another_node_become_frames_and_are_not_sent_back(
    router: tuple[str, Any], node: RosNode, frames: list[Frame]
) -> None:
    session = router[1]
    echoed: list[Any] = []
    rgb = np.random.default_rng(0).integers(0, 255, (CAMERA.height, CAMERA.width, 3), np.uint8)
    depth = np.full(rgb.shape[:2], 1.5, np.float32)
    publishers = {}

    def publish(topic: str, message: Any) -> None:
        if topic not in publishers:
            package, _, name = type_of(message).split("/")
            hashed = typestore().hash_rihs01(type_of(message))
            publishers[topic] = session.declare_publisher(f"7{topic}/{package}::msg::dds_::{name}_/{hashed}")
        publishers[topic].put(to_cdr(message))

    listener = session.declare_subscriber(
        "7/camera/color/image_raw/**", echoed.append, allowed_origin=zenoh.Locality.REMOTE
    )

    def sent() -> bool:
        publish("/camera/color/camera_info", camera_info_message(1.0, CAMERA))
        publish("/camera/color/image_raw", image_message(1.0, rgb))
        publish("/camera/depth/image_raw", image_message(1.0, depth))
        time.sleep(0.1)
        return bool(frames)

    until(sent)
    np.testing.assert_array_equal(frames[0].rgb, rgb)
    np.testing.assert_array_equal(frames[0].depth, depth)
    assert not echoed
    listener.undeclare()


def test_bytes_that_are_no_message_are_logged_and_the_next_is_heard(
    router: tuple[str, Any], node: RosNode, caplog: pytest.LogCaptureFixture
) -> None:
    key = f"7/joint_states/sensor_msgs::msg::dds_::JointState_/{typestore().hash_rihs01('sensor_msgs/msg/JointState')}"
    news = node.graph.subscribe("/joint_states", capacity=4)
    message = build("sensor_msgs/msg/JointState", name=["a"], position=[0.25])

    def heard() -> bool:
        router[1].put(key, b"\x00\x01")
        router[1].put(key, to_cdr(message))
        found = news.get(0.2)
        return found is not None and found.value.message.position[0] == 0.25

    until(heard)
    assert "from Zenoh" in caplog.text


def test_a_router_that_is_not_there_is_waited_for_and_a_malformed_one_is_refused() -> None:
    node = RosNode(MapStore())
    bridge = ZenohBridge(node.graph, "tcp/127.0.0.1:9")
    bridge.start()
    bridge.stop()
    with pytest.raises(ConfigError, match="zenoh_router"):
        ZenohBridge(node.graph, "nonsense")


def test_a_static_transform_of_before_the_start_is_heard(router: tuple[str, Any]) -> None:
    """robot_state_publisher sends /tf_static once, when it starts."""
    from zenoh import ext

    kind = "tf2_msgs/msg/TFMessage"
    key = f"7/tf_static/tf2_msgs::msg::dds_::TFMessage_/{typestore().hash_rihs01(kind)}"
    publisher = ext.declare_advanced_publisher(router[1], key, cache=ext.CacheConfig(1), publisher_detection=True)
    mount = {"header": {"frame_id": "hand"}, "child_frame_id": "camera", "transform": {"rotation": {"w": 1.0}}}
    publisher.put(to_cdr(build(kind, transforms=[mount])))
    store = MapStore()
    news = store.bus.subscribe(ROS_ROBOT, capacity=4)
    node = RosNode(store)
    node.start()
    bridge = ZenohBridge(node.graph, router[0], domain=7)
    bridge.start()
    message = news.get(30.0)
    bridge.stop()
    node.stop()
    assert message is not None
    topic, heard = message.value
    assert (topic, heard.transforms[0].child_frame_id) == ("/tf_static", "camera")

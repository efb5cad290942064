"""Streams of recordings: lost, doubled and late messages, and clocks; written by rosbags, read by splatbot."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from rosbags.rosbag1 import Writer as Ros1Writer
from rosbags.rosbag2 import StoragePlugin
from rosbags.rosbag2 import Writer as Ros2Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from splatbot.cli import main
from splatbot.cli.info import _printable
from splatbot.errors import LogError
from splatbot.logs import open_log
from splatbot.logs.record import record
from splatbot.logs.streams import bag_streams, describe_stream

CLOCK = 0.004  # [s] from stamp to reception


def test_gaps_doubles_and_order_are_counted() -> None:
    stamps = np.array([0.0, 0.1, 0.2, 0.5, 0.4, 0.5, 0.6, 0.9])
    found = describe_stream("a", "k", stamps, stamps + CLOCK)
    assert (found.count, found.dropped, found.duplicates, found.out_of_order) == (8, 3, 1, 1)
    assert found.rate == pytest.approx(6 / 0.9)
    assert found.clock_offset == pytest.approx(CLOCK)
    for few in ([], [1.0], [1.0, 1.0]):
        assert describe_stream("a", "k", np.array(few)).rate is None


def _messages(store: Any, ros1: bool) -> list[tuple[str, str, Any, float, float]]:
    """Return topic, type, message, stamp and reception of a recording whose third image is doubled and one late."""
    types = store.types

    def header(stamp: float, frame: str) -> Any:
        time = types["builtin_interfaces/msg/Time"](sec=int(stamp), nanosec=round(stamp % 1 * 1e9))
        more = {"seq": 0} if ros1 else {}
        return types["std_msgs/msg/Header"](stamp=time, frame_id=frame, **more)

    found: list[tuple[str, str, Any, float, float]] = []
    for at, stamp in enumerate((10.0, 10.1, 10.2, 10.2, 10.4, 10.3)):
        image = types["sensor_msgs/msg/Image"](
            header=header(stamp, "cam"), height=2, width=3, encoding="rgb8", is_bigendian=0, step=9,
            data=np.zeros(18, np.uint8),
        )  # fmt: skip
        found.append(("/color", "sensor_msgs/msg/Image", image, stamp, 10.0 + 0.1 * at + CLOCK))
    transform = types["geometry_msgs/msg/TransformStamped"](
        header=header(10.0, "base"),
        child_frame_id="tool",
        transform=types["geometry_msgs/msg/Transform"](
            translation=types["geometry_msgs/msg/Vector3"](x=0.0, y=0.0, z=1.0),
            rotation=types["geometry_msgs/msg/Quaternion"](x=0.0, y=0.0, z=0.0, w=1.0),
        ),
    )
    found.append(("/tf", "tf2_msgs/msg/TFMessage", types["tf2_msgs/msg/TFMessage"](transforms=[transform]), 10.0, 10.0))
    joints = types["sensor_msgs/msg/JointState"](
        header=header(10.0, ""), name=["a", "b"], position=np.zeros(2), velocity=np.zeros(0), effort=np.zeros(0)
    )
    found.append(("/joint_states", "sensor_msgs/msg/JointState", joints, 10.0, 10.5))
    return found


@pytest.fixture(params=["ROS 1", "rosbag2", "MCAP"])
def recording(request: pytest.FixtureRequest, tmp_path: Path) -> Path:
    ros1 = request.param == "ROS 1"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_JAZZY)
    if ros1:
        store.register(get_types_from_msg("geometry_msgs/TransformStamped[] transforms\n", "tf2_msgs/msg/TFMessage"))
    messages = _messages(store, ros1)
    topics: dict[str, Any] = {}
    if ros1:
        with Ros1Writer(tmp_path / "a.bag") as bag:
            for topic, kind, message, _, received in messages:
                topics[topic] = topics.get(topic) or bag.add_connection(topic, kind, typestore=store)
                bag.write(topics[topic], round(received * 1e9), store.serialize_ros1(message, kind))
        return tmp_path / "a.bag"
    plugin = StoragePlugin.MCAP if request.param == "MCAP" else StoragePlugin.SQLITE3
    with Ros2Writer(tmp_path / "a", version=9, storage_plugin=plugin) as bag2:
        for topic, kind, message, _, received in messages:
            topics[topic] = topics.get(topic) or bag2.add_connection(topic, kind, typestore=store)
            bag2.write(topics[topic], round(received * 1e9), store.serialize_cdr(message, kind))
    return next((tmp_path / "a").glob("*.mcap")) if request.param == "MCAP" else tmp_path / "a"


def test_every_topic_of_a_recording_is_described(recording: Path, capsys: pytest.CaptureFixture[str]) -> None:
    color, joints, tf = bag_streams(recording)
    assert [color.name, joints.name, tf.name] == ["/color", "/joint_states", "/tf"]
    assert (color.count, color.duplicates, color.out_of_order, color.dropped) == (6, 1, 1, 0)
    assert color.rate == pytest.approx(10.0)
    assert color.clock_offset == pytest.approx(CLOCK, abs=1e-6)
    assert (color.note, joints.note, tf.note) == ("3x2 rgb8, frame cam", "a, b", "base > tool")
    assert joints.clock_offset == pytest.approx(0.5)
    assert tf.clock_offset is None
    assert main(["info", str(recording)]) == 2  # there is no depth, but the streams are listed
    told = capsys.readouterr()
    assert "base > tool" in told.out
    assert "no depth images" in told.err


def test_texts_of_a_recording_neither_move_the_cursor_nor_are_markup() -> None:
    assert _printable("[red]a\x1b[2Jb\n") == "\\[red]a?[2Jb?"


def test_a_damaged_recording_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "a.bag").write_bytes(b"#ROSBAG V2.0\n" + bytes(100))
    with pytest.raises(LogError, match="cannot be read"):
        bag_streams(tmp_path / "a.bag")
    with pytest.raises(LogError, match="does not exist"):
        bag_streams(tmp_path / "b.bag")


def test_point_clouds_are_listed_and_the_error_says_that_they_cannot_be_mapped(
    data_root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    bag = data_root / "moveit_perception_tutorial.bag"
    assert main(["info", str(bag)]) == 2
    told = capsys.readouterr()
    assert "640x480 points in camera_rgb_optical_frame: x, y, z, rgb" in told.out
    assert "Point clouds cannot be mapped" in told.err


def test_the_first_frame_is_written_as_a_picture(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    frames = list(open_log("synthetic:tabletop?frames=3&width=160&height=120"))
    folder = record(frames, tmp_path / "log")
    assert main(["info", str(folder), "--picture", str(tmp_path / "first.png")]) == 0
    assert "rgb.txt" in capsys.readouterr().out
    image = cv2.imread(str(tmp_path / "first.png"))
    assert image is not None
    assert image.shape == (120, 320, 3)
    np.testing.assert_array_equal(image[:, :160, ::-1], frames[0].rgb)

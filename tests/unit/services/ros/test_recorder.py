"""Topics recorded into MCAP files."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from rosbags.highlevel import AnyReader

from splatbot.errors import LogError
from splatbot.frame import Frame
from splatbot.logs import open_log
from splatbot.logs.mcap import McapFile
from splatbot.logs.ros_types import Message, build
from splatbot.services.ros.graph import RosGraph
from splatbot.services.ros.publishers import RosPublishers
from splatbot.services.ros.recorder import McapRecorder
from splatbot.services.store import MapStore
from splatbot.services.topics import FRAME, map_topic
from tests.conftest import MakeLog


def _string(text: str) -> Message:
    return build("std_msgs/msg/String", data=text)


def test_all_topics_are_recorded_with_those_that_come_later_and_the_latched(tmp_path: Path) -> None:
    graph = RosGraph()
    graph.publish("/latched", _string("kept"), latched=True)
    graph.publish("/passing", _string("gone"))
    recorder = McapRecorder(graph, tmp_path / "a.mcap")
    for i in range(50):
        graph.publish(f"/late{i % 2}", _string(str(i)))
    path = recorder.stop()
    with AnyReader([path]) as reader:
        told = [(c.topic, reader.deserialize(raw, c.msgtype).data) for c, _, raw in reader.messages()]  # type: ignore[attr-defined]
    assert ("/latched", "kept") in told
    assert [t for t in told if t[0] == "/late1"] == [("/late1", str(i)) for i in range(1, 50, 2)]
    assert (recorder.messages, recorder.lost, recorder.error) == (51, 0, None)


def test_a_service_s_recording_is_a_log_of_the_frames_it_was_given(make_log: MakeLog, tmp_path: Path) -> None:
    store, graph, log = MapStore(), RosGraph(), open_log(make_log())
    outlets = RosPublishers(store.bus, graph)
    outlets.start()
    recorder = McapRecorder(
        graph,
        tmp_path / "a.mcap",
        *(f"/camera/{t}" for t in ("color/image_raw", "depth/image_raw", "color/camera_info")),
    )
    for frame in log:
        store.bus.publish(map_topic("default", FRAME), frame)
    while recorder.messages < 15:
        assert recorder.error is None
    outlets.stop()
    back = open_log(recorder.stop())
    frames: list[tuple[Frame, Frame]] = list(zip(log, back, strict=True))
    for a, b in frames:
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.depth, b.depth)
        assert a.stamp == pytest.approx(b.stamp, abs=1e-9)


def test_a_full_disk_ends_the_recording_and_says_so(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    graph = RosGraph()
    recorder = McapRecorder(graph, tmp_path / "a.mcap")

    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    graph.publish("/a", _string("before"))
    while recorder.messages < 1:
        assert recorder.error is None
    monkeypatch.setattr(McapFile, "write", full)
    graph.publish("/a", _string("after"))
    recorder.stop()
    assert recorder.error == "cannot be written (No space left on device)"
    with AnyReader([tmp_path / "a.mcap"]) as reader:
        assert reader.message_count == 1


def test_a_file_that_exists_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "a.mcap").write_text("mine")
    with pytest.raises(LogError, match="exists"):
        McapRecorder(RosGraph(), tmp_path / "a.mcap")
    assert (tmp_path / "a.mcap").read_text() == "mine"

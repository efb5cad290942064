"""Transforms for web pages: chains of frames, thresholds, the ends of topics."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.geometry import inverse, pose_from_quat
from splatbot.services.ros import tf_republisher
from splatbot.services.ros.graph import RosGraph
from splatbot.services.ros.messages import transform_message
from splatbot.services.ros.tf_republisher import TfRepublisher, transform_between

A = pose_from_quat((1.0, 2.0, 3.0), (0.8, 0.6, 0.0, 0.0))
B = pose_from_quat((-0.5, 0.1, 0.0), (0.6, 0.0, 0.8, 0.0))
REQUEST = {"source_frames": ["/camera"], "target_frame": "map", "angular_thres": 0.1, "trans_thres": 0.1, "rate": 30}


@pytest.fixture
def graph() -> Iterator[RosGraph]:
    graph = RosGraph()
    republisher = TfRepublisher(graph)
    republisher.start()
    yield graph
    republisher.stop()


def ask(graph: RosGraph, **more: Any) -> str:
    return str(graph.service("/republish_tfs").call(REQUEST | more)["topic_name"])


def test_transforms_follow_the_chain_of_frames_in_both_directions() -> None:
    parents = {"arm": ("map", A), "camera": ("map", B), "tool": ("arm", B)}
    found = transform_between(parents, "camera", "tool")
    assert found is not None
    np.testing.assert_allclose(found, inverse(B) @ A @ B, atol=1e-12)
    assert transform_between(parents, "camera", "elsewhere") is None
    assert transform_between({"a": ("b", A), "b": ("a", B)}, "a", "map") is None  # a loop ends


def test_a_reader_gets_transforms_that_moved_more_than_the_thresholds(graph: RosGraph) -> None:
    topic = ask(graph)
    assert ask(graph) == topic  # equal requests share it
    graph.advertise(topic, "tf2_web_republisher/TFArray", client=7)
    reader = graph.subscribe(topic, capacity=8)
    for x, arrives in ((0.0, True), (0.05, False), (0.3, True)):
        T = pose_from_quat((x, 0.0, 0.0), (1.0, 0.0, 0.0, 0.0))
        graph.publish("/tf", transform_message(0.0, T, "map", "camera"))
        news = reader.get(5.0 if arrives else 0.3)
        assert (news is not None) is arrives
        if news is not None:
            (stamped,) = news.value.message.transforms
            assert (stamped.header.frame_id, stamped.child_frame_id) == ("map", "camera")
            assert stamped.transform.translation.x == pytest.approx(x)


def test_a_second_reader_gets_a_transform_that_does_not_move_however_late_it_subscribes(graph: RosGraph) -> None:
    topic = ask(graph)
    graph.advertise(topic, "tf2_web_republisher/TFArray", client=7)
    first = graph.subscribe(topic, capacity=8)
    graph.publish("/tf_static", transform_message(0.0, A, "map", "camera"))
    assert first.get(30.0) is not None
    assert ask(graph) == topic  # a second page
    first.get(0.2)  # the round trip to it; the topic goes on meanwhile
    second = graph.subscribe(topic, capacity=8)
    news = second.get(30.0)
    assert news is not None
    assert news.value.message.transforms[0].transform.translation.x == pytest.approx(A[0, 3])


def test_a_topic_without_a_reader_ends(graph: RosGraph) -> None:
    topic = ask(graph, timeout={"sec": 0, "nanosec": 100_000_000})
    other = graph.subscribe("/none", capacity=1)
    for _ in range(200):
        if topic not in graph.topics:
            return
        other.get(0.05)
    raise AssertionError("the topic is still there")


def test_topics_and_frames_are_bounded(graph: RosGraph, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tf_republisher, "CONSTANTS", tf_republisher.TfRepublisherConstants(requests=2, frames=3))
    for name in ("a", "b"):
        ask(graph, target_frame=name)
    with pytest.raises(InputError, match="2 already"):
        ask(graph, target_frame="c")
    requests: list[dict[str, Any]] = [
        {"source_frames": ["a"] * 4},
        {"source_frames": []},
        {"target_frame": ""},
        {"rate": "fast"},
    ]
    for wrong in requests:
        with pytest.raises(InputError):
            ask(graph, **wrong)

"""The bus's messages as ROS topics, and clients' messages as frames and joints."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
import pytest
import torch

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.geometry import look_at, pose_from_quat
from splatbot.logs import open_log
from splatbot.logs.mcap import COLOR, DEPTH, INFO, JOINTS
from splatbot.logs.ros_frames import RosFrame, camera_info_message, image_message, pose_of
from splatbot.logs.ros_types import build, from_cdr, to_cdr, to_plain
from splatbot.services.ros.graph import RosGraph
from splatbot.services.ros.messages import (
    joint_trajectory_message,
    odometry_message,
    point_cloud_message,
    points_of,
    waypoints_of,
)
from splatbot.services.ros.publishers import FROM_ROS, ODOMETRY, POINTS, ROSOUT, TF, RosPublishers
from splatbot.services.ros.robot_topics import TYPES_OF_ROBOT
from splatbot.services.ros.subscribers import FramePairs, RosSubscribers
from splatbot.services.store import MapStore
from splatbot.services.topics import FRAME, RESULT, JointState, arm_topic, map_topic, robot_topic
from splatbot.slam import FrameResult
from tests.conftest import MakeLog
from tests.models import random_model
from tests.waiting import until


def _until(found: Callable[[], Any]) -> Any:
    until(lambda: found() is not None)
    return found()


@pytest.fixture
def told() -> Iterator[tuple[MapStore, RosGraph]]:
    """A store whose news come out on a graph."""
    store, graph = MapStore(), RosGraph()
    outlets = RosPublishers(store.bus, graph)
    outlets.start()
    yield store, graph
    outlets.stop()


def test_a_cloud_keeps_the_whole_splat(rng: np.random.Generator) -> None:
    model = random_model(100, rng, least=0.001)
    back = points_of(from_cdr(to_cdr(point_cloud_message(model, 1.0)), "sensor_msgs/msg/PointCloud2"))
    np.testing.assert_array_equal(np.stack([back["x"], back["y"], back["z"]], -1), model.means.numpy())
    np.testing.assert_allclose(back["rgb"], model.colors.numpy(), atol=0.5 / 255 + 1e-6)
    again = GaussianModel.from_activated(
        means=model.means,
        quats=np.stack([back[f"rot_{a}"] for a in "wxyz"], -1),
        scales=np.stack([back[f"scale_{a}"] for a in "xyz"], -1),
        opacities=back["opacity"],
        colors=back["rgb"],
    )
    torch.testing.assert_close(again.quats, torch.nn.functional.normalize(model.quats, dim=1))
    torch.testing.assert_close(again.scales, model.scales)


def test_odometry_turns_the_covariance_to_the_map_s_axes() -> None:
    T = look_at(np.array([1.0, 2.0, 3.0]), np.zeros(3))
    C = np.diag([1e-4, 2e-4, 3e-4, 1e-6, 2e-6, 3e-6])
    message = odometry_message(FrameResult(0, 2.5, T, "ok", covariance=C))
    np.testing.assert_allclose(pose_of(message.pose.pose), T, atol=1e-12)
    rng = np.random.default_rng(0)
    moved = T[:3, :3] @ rng.multivariate_normal(np.zeros(3), C[:3, :3], 200_000).T  # of the camera, in the map
    np.testing.assert_allclose(np.cov(moved), message.pose.covariance.reshape(6, 6)[:3, :3], atol=3e-6)
    assert (message.header.frame_id, message.child_frame_id) == ("map", "camera")


def test_joints_come_out_as_the_robot_s_and_as_the_arm_s(told: tuple[MapStore, RosGraph]) -> None:
    store, graph = told
    reader = graph.subscribe(JOINTS, "/fake/joint_states", "/twin/joint_states", capacity=16)
    for arm, q in (("fake", 0.5), ("twin", 1.5)):
        state = JointState(1.0, ("a",), np.array([q]))
        store.bus.publish(robot_topic("panda", "joints"), state)
        store.bus.publish(arm_topic(arm, "joints"), state)
    news = [m for m in (reader.get(5) for _ in range(4)) if m is not None]
    told_joints = [(m.topic, float(m.value.message.position[0])) for m in news]
    assert sorted(told_joints) == [
        ("/fake/joint_states", 0.5), (JOINTS, 0.5), (JOINTS, 1.5), ("/twin/joint_states", 1.5)
    ]  # fmt: skip


def test_news_of_a_map_come_out_under_their_ros_names(
    told: tuple[MapStore, RosGraph], rng: np.random.Generator
) -> None:
    store, graph = told
    reader = graph.subscribe(ODOMETRY, TF, COLOR, DEPTH, INFO, capacity=16)
    store.add("default", source="a", state="mapping", snapshot=Snapshot(random_model(100, rng, least=0.001), 1, 3.0))
    cloud = _until(lambda: graph.latched(POINTS)).message
    assert (cloud.width, cloud.header.stamp.sec) == (100, 3)
    T = pose_from_quat((1, 2, 3), (0.5, 0.5, -0.5, 0.5))
    store.bus.publish(map_topic("default", RESULT), FrameResult(0, 4.0, T, "ok"))
    store.bus.publish(map_topic("default", RESULT), FrameResult(1, 5.0, None, "lost"))
    camera = Camera(50, 50, 31.5, 23.5, 64, 48)
    frame = Frame(6.0, np.full((48, 64, 3), 7, np.uint8), np.ones((48, 64), np.float32), camera)
    store.bus.publish(map_topic("default", FRAME), frame)
    news = {m.topic: m.value.message for m in (reader.get(5) for _ in range(5)) if m is not None}
    assert set(news) == {ODOMETRY, TF, COLOR, DEPTH, INFO}
    assert news[ODOMETRY].header.stamp.sec == 4
    np.testing.assert_allclose(pose_of(news[TF].transforms[0].transform), T, atol=1e-12)
    orientation = to_plain(news[ODOMETRY].pose.pose.orientation)
    assert orientation == pytest.approx({"x": 0.5, "y": -0.5, "z": 0.5, "w": 0.5})
    assert reader.get(0.1) is None


def test_a_second_map_has_names_of_its_own(told: tuple[MapStore, RosGraph], rng: np.random.Generator) -> None:
    store, graph = told
    for name in ("default", "desk-2"):
        store.add(name, source="a", state="static", snapshot=Snapshot(random_model(100, rng, least=0.001), 1))
    assert _until(lambda: graph.latched("/maps/desk_2/map/points")) is not None


def test_warnings_come_out_on_rosout(told: tuple[MapStore, RosGraph]) -> None:
    _, graph = told
    reader = graph.subscribe(ROSOUT, capacity=4)
    logging.getLogger("splatbot.tracking").warning("lost the %s", "cup")
    news = reader.get(5)
    assert news is not None
    assert (news.value.message.level, news.value.message.msg) == (30, "lost the cup")


def test_nobody_pays_for_messages_that_nobody_reads(told: tuple[MapStore, RosGraph]) -> None:
    store, graph = told
    made: list[int] = []
    graph.publish_later("/a", "std_msgs/msg/String", lambda: made.append(1) or build("std_msgs/msg/String"))  # type: ignore[func-returns-value]
    reader = graph.subscribe("/a", capacity=1)
    assert made == []
    graph.publish_later("/a", "std_msgs/msg/String", lambda: made.append(1) or build("std_msgs/msg/String"))  # type: ignore[func-returns-value]
    news = reader.get(1)
    assert news is not None
    assert [news.value.cdr, news.value.json, made] == [news.value.cdr, '{"data":""}', [1]]
    assert store.list() == ()


def test_images_of_a_client_become_frames_and_joint_states_are_taken(make_log: MakeLog) -> None:
    graph, states = RosGraph(), list[JointState]()
    frames: list[Frame] = []
    heard: list[str] = []
    inlets = RosSubscribers(graph, states.append, lambda topic, _: heard.append(topic), on_frame=frames.append)
    inlets.start()
    log = open_log(make_log())
    for frame in log:
        graph.publish(INFO, camera_info_message(frame.stamp, frame.camera), client=1)
        graph.publish(DEPTH, image_message(frame.stamp + 0.005, frame.depth), client=1)
        graph.publish(COLOR, image_message(frame.stamp, frame.rgb), client=1)
        count = frame.index + 1
        _until(lambda: True if len(frames) == count else None)  # noqa: B023 - called at once
    graph.publish(COLOR, image_message(9.0, log[0].rgb))  # the service's own are left alone
    graph.publish(JOINTS, build("sensor_msgs/msg/JointState", name=["a", "b"], position=[0.5, 1.0]), client=1)
    graph.publish(JOINTS, build("sensor_msgs/msg/JointState", name=["a", "b"], position=[0.5]), client=1)
    state: JointState = _until(lambda: states[0] if states else None)
    graph.publish(TF, build(TYPES_OF_ROBOT[TF]))  # the service's own
    for topic, kind in TYPES_OF_ROBOT.items():
        graph.publish(topic, build(kind), client=1)
    _until(lambda: len(heard) == len(TYPES_OF_ROBOT) or None)
    inlets.stop()
    assert heard == list(TYPES_OF_ROBOT)
    assert len(states) == 1
    assert (state.names, state.position.tolist()) == (("a", "b"), [0.5, 1.0])
    assert [f.stamp for f in frames] == pytest.approx([f.stamp for f in log], abs=1e-9)
    for a, b in zip(log, frames, strict=True):
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.depth, b.depth)
        assert (b.camera, b.source) == (a.camera, FROM_ROS)
        assert isinstance(b, RosFrame)
        assert b.camera_frame == "camera"


def test_a_problem_of_many_messages_is_logged_once(make_log: MakeLog, caplog: pytest.LogCaptureFixture) -> None:
    graph, frame, states = RosGraph(), open_log(make_log())[0], list[JointState]()
    inlets = RosSubscribers(graph, states.append, lambda *_: None, on_frame=lambda _: None)
    graph.publish(INFO, camera_info_message(frame.stamp, frame.camera), client=1)
    inlets.start()
    for k in range(5):
        graph.publish(COLOR, image_message(float(k), frame.rgb, "color"), client=1)
        graph.publish(DEPTH, image_message(float(k), frame.depth, "depth"), client=1)
    _until(lambda: "depth has no camera_info" in caplog.text or None)
    inlets.stop()
    assert caplog.text.count("depth has no camera_info") == 1


def test_images_without_a_partner_or_intrinsics_wait_and_are_forgotten_in_the_end(make_log: MakeLog) -> None:
    pairs, frame = FramePairs(), open_log(make_log())[0]
    assert pairs.add(COLOR, image_message(0.0, frame.rgb)) is None
    assert pairs.add(DEPTH, image_message(0.0, frame.depth)) is None  # no intrinsics yet
    assert pairs.add(INFO, camera_info_message(0.0, frame.camera)) is None
    assert pairs.add(DEPTH, image_message(0.5, frame.depth)) is None  # too late
    for i in range(100):
        pairs.add(COLOR, image_message(10.0 + i, frame.rgb))
    assert pairs.add(DEPTH, image_message(10.0, frame.depth)) is None
    found = pairs.add(DEPTH, image_message(109.0, frame.depth))
    assert found is not None
    assert found.stamp == 109.0


def test_a_trajectory_of_ros_is_read_back() -> None:
    from tests.unit.services.ros.motion import swing

    plan = swing()
    names, times, positions = waypoints_of(joint_trajectory_message(plan))
    assert names == plan.names
    np.testing.assert_allclose(positions, plan.at(times).position, atol=1e-9)


@pytest.mark.parametrize(
    "points",
    [[], [{"positions": [1.0]}], [{"positions": [1.0, 2.0]}, {"positions": [1.0, 2.0]}], [{"positions": [1.0, None]}]],
)
def test_a_trajectory_that_makes_no_sense_is_refused(points: list[dict[str, Any]]) -> None:
    message = build("trajectory_msgs/msg/JointTrajectory", joint_names=["a", "b"], points=points)
    with pytest.raises(InputError, match="points"):
        waypoints_of(message)

"""Motions that ROS clients send."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest

from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.geometry import pose_from_quat
from splatbot.logs.ros_types import build
from splatbot.robots.controllers import FakeController
from splatbot.robots.store import load_robot
from splatbot.services.arms import Arms
from splatbot.services.bus import Subscription
from splatbot.services.ros.follow import FollowJointTrajectory, action_topic
from splatbot.services.ros.graph import RosGraph
from splatbot.services.store import MapStore
from splatbot.workspace import Workspace

PANDA = load_robot("panda")
BASE = pose_from_quat((0, 0, 0), (1, 0, 0, 0))
GOAL = "control_msgs/msg/FollowJointTrajectoryActionGoal"


def _points(seconds: float = 0.6, turn: float = 0.3) -> list[dict[str, Any]]:
    shares = np.linspace(0, 1, 13)
    smooth = shares**2 * (3 - 2 * shares)
    stamps = [{"sec": int(t), "nanosec": round(t % 1 * 1e9)} for t in shares * seconds]
    q = np.asarray(PANDA.home) + turn * smooth[:, None] * np.eye(7)[0]
    return [{"positions": list(p[::-1]), "time_from_start": t} for p, t in zip(q, stamps, strict=True)]


class Scene:
    """An arm next to a ball, and a client."""

    def __init__(self, at: Any) -> None:
        ball = GaussianModel.from_activated(
            means=[at], quats=[[1.0, 0, 0, 0]], scales=[[0.05] * 3], opacities=[0.9], colors=[[1.0, 0, 0]]
        )
        self.graph, self.store = RosGraph(), MapStore()
        workspace = Workspace(T_world_base=BASE)
        self.store.add("desk", source="a", state="static", snapshot=Snapshot(ball, 1), workspace=workspace)
        self.arms = Arms(self.store, {"fake": lambda robot: FakeController(robot.home, period=0.005)})
        self.action = FollowJointTrajectory(self.graph, self.arms, self.store)
        for client in (1, 2):  # as the WebSocket of each does
            self.graph.join(client)
        self.action.start()
        self.results = self.read("result")
        self.feedback = self.read("feedback")

    def read(self, part: str) -> Subscription:
        return self.graph.subscribe(action_topic("fake", part), capacity=1000)

    def send(self, points: list[dict[str, Any]], name: str = "1", *, client: int = 1, part: str = "") -> None:
        trajectory = {"joint_names": list(PANDA.chain.names)[::-1], "points": points}
        more = {part: [{"name": "panda_joint1", "position": 0.01}]} if part else {}
        message = build(GOAL, goal_id={"id": name}, goal={"trajectory": trajectory} | more)
        self.graph.publish(action_topic("fake", "goal"), message, client=client)

    def result(self) -> Any:
        news = self.results.get(20)
        assert news is not None
        return news.value.message

    def close(self) -> None:
        self.action.stop()
        self.arms.close(5)


@pytest.fixture
def scene() -> Iterator[Scene]:
    made = Scene((3.0, 0.0, 0.0))
    yield made
    made.close()


def test_a_goal_is_followed_with_feedback_to_its_end(scene: Scene, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("splatbot.services.arms._FEEDBACK_PERIOD_S", 0.0)  # of each step: a busy machine may be late
    scene.send(_points())
    done = scene.result()
    assert (done.status.goal_id.id, done.status.status, done.result.error_code) == ("1", 3, 0)
    assert scene.arms.get("fake").feedback is not None
    np.testing.assert_allclose(
        scene.arms.get("fake").feedback.position,  # type: ignore[union-attr]
        np.asarray(PANDA.home) + 0.3 * np.eye(7)[0],
        atol=1e-6,
    )
    told = [m.value.message for m in iter(lambda: scene.feedback.get(0.05), None)]
    assert len(told) > 5
    assert {m.status.goal_id.id for m in told} == {"1"}
    assert list(told[0].feedback.joint_names) == list(PANDA.chain.names)
    first = [m.feedback.actual.positions[0] for m in told]
    assert first == sorted(first)


def test_a_goal_is_cancelled_and_the_arm_stands(scene: Scene) -> None:
    scene.send(_points(seconds=30.0), "long")
    assert scene.feedback.get(10) is not None
    scene.graph.publish(action_topic("fake", "cancel"), build("actionlib_msgs/msg/GoalID", id="long"), client=1)
    done = scene.result()
    assert (done.status.goal_id.id, done.status.status) == ("long", 2)
    assert abs(scene.arms.get("fake").feedback.position[0]) < 0.29  # type: ignore[union-attr]


def test_what_is_not_free_or_makes_no_sense_is_rejected_and_nothing_moves() -> None:
    hand = PANDA.tcp(np.asarray(PANDA.home) + 0.3 * np.eye(7)[0])[:3, 3]
    scene = Scene(hand)
    try:
        scene.send(_points())
        done = scene.result()
        assert (done.status.status, done.result.error_code) == (5, -1)
        assert "not certified as free" in done.result.error_string
        for points, why in (
            ([], "points"),
            ([{"positions": [0.0] * 3}], "points"),
            ([{"positions": [9.0] * 7, "time_from_start": {"sec": 9}}], "limit"),
        ):
            scene.send(points)
            assert why in scene.result().result.error_string
        assert scene.feedback.get(0.05) is None
    finally:
        scene.close()


def test_a_goal_that_begins_elsewhere_or_while_the_arm_moves_is_rejected(scene: Scene) -> None:
    far = [point | {"positions": [q + 0.05 for q in point["positions"]]} for point in _points()]
    scene.send(far, "elsewhere")
    assert scene.result().status.status == 5
    scene.send(_points(seconds=5.0), "first")
    assert scene.feedback.get(10) is not None
    scene.send(_points(), "second")
    done = scene.result()
    assert (done.status.goal_id.id, done.status.status) == ("second", 5)
    scene.graph.publish(action_topic("fake", "cancel"), build("actionlib_msgs/msg/GoalID"), client=1)
    assert scene.result().status.goal_id.id == "first"


def test_a_single_point_is_reached_from_where_the_arm_is(scene: Scene) -> None:
    goal = np.asarray(PANDA.home) + 0.2 * np.eye(7)[0]
    scene.send([{"positions": list(goal[::-1]), "time_from_start": {"sec": 1}}])
    assert scene.result().status.status == 3
    np.testing.assert_allclose(scene.arms.get("fake").feedback.position, goal, atol=1e-6)  # type: ignore[union-attr]


def test_the_arm_stops_when_its_client_leaves(scene: Scene) -> None:
    scene.send(_points(seconds=30.0))
    assert scene.feedback.get(10) is not None
    scene.graph.leave(1)
    done = scene.result()
    assert done.status.status == 4
    assert "owner is gone" in done.result.error_string
    assert scene.arms.leases.of("fake") is None


def test_another_client_cannot_command_a_leased_arm(scene: Scene) -> None:
    scene.send(_points(seconds=1.0))
    assert scene.result().status.status == 3
    scene.send(_points(), "second", client=2)
    done = scene.result()
    assert (done.status.goal_id.id, done.status.status) == ("second", 5)
    assert "another client" in done.result.error_string


def test_parts_of_a_goal_that_would_be_ignored_are_refused_by_name(scene: Scene) -> None:
    for part in ("path_tolerance", "goal_tolerance"):
        scene.send(_points(), part=part)
        assert part in scene.result().result.error_string

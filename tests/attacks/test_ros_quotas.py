"""Attacks on the ROS side: topics without end, messages that are never freed, stops that come too late."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from functools import partial
from typing import Any

import numpy as np
import pytest
from websockets.sync.client import connect
from websockets.sync.connection import Connection

from splatbot.geometry import pose_from_quat
from splatbot.services.arms import known_robot
from splatbot.services.motion_gate import MotionGate
from splatbot.services.ros.graph import CLIENT_RETAINED_BYTES, CLIENT_SERVICES, CLIENT_TOPICS, RosGraph
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from splatbot.workspace import Workspace
from tests.contracts.conftest import Service, running, wall
from tests.waiting import until

ACTION = "/fake_controller/follow_joint_trajectory"
STRING = "std_msgs/msg/String"


@pytest.fixture
def served() -> Iterator[Service]:
    store = MapStore()
    there = Workspace(T_world_base=pose_from_quat((0, 0, -20), (1, 0, 0, 0)))
    store.add("default", source="wall.ply", state="static", snapshot=wall(), workspace=there)
    with running(ServiceSettings(), store) as service:
        yield service


@contextmanager
def ros(service: Service) -> Iterator[Connection]:
    with connect(service.ws("/rosbridge"), max_size=None) as client:
        yield client


def say(client: Connection, **operation: Any) -> None:
    client.send(json.dumps(operation))


def hear(client: Connection, op: str, timeout_s: float = 10) -> dict[str, Any]:
    deadline = time.monotonic() + timeout_s
    while True:
        message: dict[str, Any] = json.loads(client.recv(timeout=deadline - time.monotonic()))
        if message["op"] == op:
            return message


def call(client: Connection, name: str, /, **args: Any) -> dict[str, Any]:
    say(client, op="call_service", id="c", service=name, args=args)
    return hear(client, "service_response")


def topics(service: Service) -> set[str]:
    return set(service.app.state.ros.graph.topics)


def test_one_client_cannot_take_all_topics_and_services(served: Service) -> None:
    with ros(served) as greedy, ros(served) as other:
        for number in range(CLIENT_TOPICS + 1):
            say(greedy, op="advertise", topic=f"/greedy/t{number}", type=STRING)
        assert "one topic too many" in hear(greedy, "status")["msg"]
        for number in range(CLIENT_SERVICES + 1):
            say(greedy, op="advertise_service", service=f"/greedy/s{number}", type="std_srvs/srv/Trigger")
        assert "one service too many" in hear(greedy, "status")["msg"]
        say(other, op="advertise", topic="/other", type=STRING)
        until(lambda: "/other" in topics(served))


def test_topics_go_with_their_client(served: Service) -> None:
    before = topics(served)
    for number in range(20):
        with ros(served) as client:
            say(client, op="advertise", topic=f"/gone/{'t' * (number + 1)}", type=STRING)
            say(client, op="publish", topic=f"/gone/{'t' * (number + 1)}", msg={"data": "x"}, latch=True)
            call(client, "/rosapi/get_time")
    until(lambda: topics(served) == before)


def test_a_topic_that_another_client_reads_stays(served: Service) -> None:
    with ros(served) as reader:
        with ros(served) as writer:
            say(writer, op="advertise", topic="/shared", type=STRING)
            call(writer, "/rosapi/get_time")
            say(reader, op="subscribe", topic="/shared", type=STRING)
            call(reader, "/rosapi/get_time")
        time.sleep(0.3)
        assert "/shared" in topics(served)
    until(lambda: "/shared" not in topics(served))


def test_only_latched_messages_are_kept_and_no_more_than_a_client_may(served: Service) -> None:
    graph = served.app.state.ros.graph
    with ros(served) as client:
        say(client, op="advertise", topic="/a", type=STRING)
        say(client, op="publish", topic="/a", msg={"data": "x" * 1000})
        call(client, "/rosapi/get_time")
        assert graph._bus.latest("/a") is None
        part = "x" * (CLIENT_RETAINED_BYTES // 2 + 1000)
        for topic in ("/b", "/c"):
            say(client, op="advertise", topic=topic, type=STRING)
            say(client, op="publish", topic=topic, msg={"data": part}, latch=True)
        assert "kept" in hear(client, "status")["msg"]
        say(client, op="publish", topic="/b", msg={"data": part}, latch=True)  # replaces its own
        call(client, "/rosapi/get_time")
        assert graph.latched("/b") is not None


def _published(graph: RosGraph, name: str) -> bool:
    """Return whether the points of a map are published, as the default map or under its name."""
    return bool(graph.latched("/map/points") or graph.latched(f"/maps/{name}/map/points"))


def test_topics_of_deleted_maps_go(served: Service) -> None:
    graph = served.app.state.ros.graph
    served.store.remove("default")
    for number in range(40):
        name = f"m{number}"
        served.store.add(name, source="x", state="static", snapshot=wall())
        until(partial(_published, graph, name))
        served.store.remove(name)
        until(lambda: not any(topic.startswith("/maps/") for topic in topics(served)))
    served.store.add("last", source="x", state="static", snapshot=wall())
    until(partial(_published, graph, "last"))


def test_a_second_subscription_of_a_connection_gets_the_latched_message(served: Service) -> None:
    with ros(served) as client:
        for name in ("one", "two"):
            say(client, op="subscribe", id=name, topic="/map/points", compression="none")
            assert hear(client, "publish")["msg"]["width"] == 2601


@pytest.mark.parametrize("how", ["call", "empty", "true"])
def test_a_ros_client_can_stop_all_arms(served: Service, how: str) -> None:
    with ros(served) as client:
        if how == "call":
            assert call(client, "/emergency_stop")["values"]["success"] is True
        elif how == "empty":
            say(client, op="publish", topic="/emergency_stop", msg={})
        else:
            say(client, op="advertise", topic="/emergency_stop", type="std_msgs/Bool")
            say(client, op="publish", topic="/emergency_stop", msg={"data": True})
        until(lambda: served.runtime.arms.emergency_stop is not None)


def test_a_stop_of_false_stops_nothing(served: Service) -> None:
    with ros(served) as client:
        say(client, op="publish", topic="/emergency_stop", msg={"data": False})
        call(client, "/rosapi/get_time")
    assert served.runtime.arms.emergency_stop is None


def goal(to: float, seconds: int) -> dict[str, Any]:
    chain, home = known_robot("panda").chain, np.array(known_robot("panda").home)
    turned = home + to * np.eye(7)[0]
    points = [
        {"positions": q.tolist(), "time_from_start": {"sec": s, "nanosec": 0}}
        for q, s in ((home, 0), (turned, seconds))
    ]
    return {"trajectory": {"joint_names": list(chain.names), "points": points}}


def send_goal(client: Connection, name: str, args: dict[str, Any]) -> None:
    kind = "control_msgs/action/FollowJointTrajectory"
    say(client, op="send_action_goal", id=name, action=ACTION, action_type=kind, args=args, feedback=True)


def test_an_action_goal_of_rosbridge_moves_the_arm_with_feedback_and_a_result(served: Service) -> None:
    with ros(served) as client:
        send_goal(client, "g1", goal(0.2, 2))
        feedback = hear(client, "action_feedback")
        assert (feedback["action"], feedback["id"], len(feedback["values"]["joint_names"])) == (ACTION, "g1", 7)
        result = hear(client, "action_result", 20)
        assert (result["id"], result["status"], result["result"]) == ("g1", 4, True)


def test_an_action_goal_can_be_cancelled_and_another_client_is_refused(served: Service) -> None:
    with ros(served) as client, ros(served) as thief:
        send_goal(client, "g1", goal(0.5, 20))
        hear(client, "action_feedback")
        send_goal(thief, "g1", goal(0.5, 20))
        refused = hear(thief, "action_result")
        assert (refused["status"], refused["result"]) == (6, False)
        assert "belongs to another client" in refused["values"]["error_string"]
        say(thief, op="cancel_action_goal", id="g1", action=ACTION)
        time.sleep(0.3)
        assert served.runtime.arms.get("fake").busy
        say(client, op="cancel_action_goal", id="g1", action=ACTION)
        assert hear(client, "action_result", 20)["status"] == 5


def test_an_arm_stops_when_the_client_of_its_action_leaves(served: Service) -> None:
    with ros(served) as client:
        send_goal(client, "g1", goal(0.5, 20))
        hear(client, "action_feedback")
    until(lambda: not served.runtime.arms.get("fake").busy, 5)


def test_an_unknown_action_is_refused(served: Service) -> None:
    with ros(served) as client:
        say(client, op="send_action_goal", id="g", action="/none", action_type="a/B", args={})
        assert hear(client, "action_result")["result"] is False


def test_the_rest_of_rosapi_answers(served: Service) -> None:
    with ros(served) as client:
        assert ACTION in call(client, "/rosapi/action_servers")["values"]["action_servers"]
        kind = call(client, "/rosapi/action_type", action=ACTION)["values"]["type"]
        assert kind == "control_msgs/action/FollowJointTrajectory"
        assert call(client, "/rosapi/service_node", service="/compute_ik")["values"] == {"node": "/splatbot"}
        details = call(client, "/rosapi/node_details", node="/splatbot")["values"]
        assert "/odom" in details["publishing"]
        assert "/compute_ik" in details["services"]
        for part in ("goal", "feedback", "result"):
            found = call(client, f"/rosapi/action_{part}_details", type=kind)["values"]["typedefs"]
            assert found[0]["type"] == f"control_msgs/msg/FollowJointTrajectory{part.capitalize()}"
        assert call(client, "/rosapi/get_param", name="/a", default="5")["values"]["value"] == "5"
        for name in ("get_param_names", "has_param", "set_param", "delete_param", "interfaces", "service_providers"):
            assert call(client, f"/rosapi/{name}")["result"] is True


def test_a_client_that_leaves_before_its_goal_is_taken_moves_nothing_and_keeps_no_lease(served: Service) -> None:
    home = served.client.get("/v1/arms/fake").json()["position"]
    for number in range(10):
        with ros(served) as client:
            send_goal(client, f"g{number}", goal(0.5, 20))
        time.sleep(0.05)
    arms = served.runtime.arms
    until(lambda: not arms.get("fake").busy and arms.leases.of("fake") is None, 5)
    time.sleep(0.3)
    assert arms.leases.of("fake") is None
    np.testing.assert_allclose(served.client.get("/v1/arms/fake").json()["position"], home, atol=0.02)


def test_the_event_loop_does_not_wait_for_a_certification_when_its_client_leaves(
    served: Service, monkeypatch: pytest.MonkeyPatch
) -> None:
    begun, gate = threading.Event(), threading.Event()
    certify = MotionGate.certify

    def slow(self: MotionGate, *args: Any) -> Any:
        begun.set()
        gate.wait(20)
        return certify(self, *args)

    monkeypatch.setattr(MotionGate, "certify", slow)
    with ros(served) as client:
        send_goal(client, "g", goal(0.5, 20))
        assert begun.wait(10)
    try:
        assert served.client.get("/healthz", timeout=5).status_code == 200
    finally:
        gate.set()
    until(lambda: not served.runtime.arms.get("fake").busy, 5)


def test_one_client_cannot_subscribe_to_a_topic_without_end(served: Service) -> None:
    with ros(served) as client:
        for number in range(65):
            say(client, op="subscribe", id=f"s{number}", topic="/odom")
        assert "one subscription too many" in hear(client, "status")["msg"]

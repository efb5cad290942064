"""rosbridge operations, without a socket."""

from __future__ import annotations

import asyncio
import base64
import json
import random
import time
from collections.abc import Awaitable, Callable
from typing import Any

import cbor2
import cv2
import numpy as np
import pytest

from splatbot.logs.ros_types import build, from_cdr
from splatbot.services.keys import SCOPES
from splatbot.services.ros.graph import RosGraph, Service
from splatbot.services.ros.rosapi import RosApi
from splatbot.services.ros.rosbridge import RosbridgeSession

LIMIT = 100_000


class Client:
    """A session, and the messages that it received."""

    def __init__(self, graph: RosGraph) -> None:
        self.sent: list[Any] = []
        self.gate = asyncio.Event()
        self.gate.set()
        self.session = RosbridgeSession(graph, self._take, most_bytes=LIMIT, scopes=SCOPES)

    async def _take(self, data: str | bytes) -> None:
        await self.gate.wait()
        self.sent.append(cbor2.loads(data) if isinstance(data, bytes) else json.loads(data))

    async def say(self, **operation: Any) -> None:
        await self.session.receive(json.dumps(operation))

    async def until(self, count: int) -> list[Any]:
        for _ in range(500):
            if len(self.sent) >= count:
                return self.sent
            await asyncio.sleep(0.01)
        raise AssertionError(f"{len(self.sent)} messages, not {count}: {self.sent}")

    async def stays_at(self, count: int) -> None:
        """Assert that no message comes after the first ``count``."""
        await asyncio.sleep(0.05)
        assert len(self.sent) == count


def play(scene: Callable[[RosGraph, Client], Awaitable[None]]) -> None:
    """Run a scene with a graph and a client."""

    async def run() -> None:
        graph = RosGraph()
        client = Client(graph)
        await scene(graph, client)
        await client.session.close()

    asyncio.run(run())


def _string(text: str) -> Any:
    return build("std_msgs/msg/String", data=text)


def _array() -> Any:
    values = np.array([1.5, np.nan, -2.0], np.float32)
    return build("std_msgs/msg/Float32MultiArray", data=values)


@pytest.mark.parametrize("compression", ["none", "png", "cbor", "cbor-raw"])
def test_a_message_arrives_in_every_compression(compression: str) -> None:
    async def scene(graph: RosGraph, client: Client) -> None:
        graph.advertise("/a", "std_msgs/Float32MultiArray")
        await client.say(op="subscribe", topic="/a", compression=compression)
        graph.publish("/a", _array())
        (told,) = await client.until(1)
        if compression == "png":
            png = np.frombuffer(base64.b64decode(told["data"]), np.uint8)
            image: Any = cv2.imdecode(png, cv2.IMREAD_COLOR)
            told = json.loads(image[..., ::-1].tobytes())
        assert (told["op"], told["topic"]) == ("publish", "/a")
        if compression == "cbor-raw":
            assert set(told["msg"]) == {"secs", "nsecs", "bytes"}
            data = from_cdr(told["msg"]["bytes"], "std_msgs/msg/Float32MultiArray").data
        elif compression == "cbor":
            tag = told["msg"]["data"]
            assert tag.tag == 85
            data = np.frombuffer(tag.value, "<f4")
        else:
            data = np.array([np.nan if v is None else v for v in told["msg"]["data"]], np.float32)
        np.testing.assert_array_equal(data, np.array([1.5, np.nan, -2.0], np.float32))

    play(scene)


def test_bytes_are_base64_in_json_and_bytes_in_cbor() -> None:
    async def scene(graph: RosGraph, client: Client) -> None:
        await client.say(op="subscribe", topic="/a", type="std_msgs/msg/UInt8MultiArray")
        graph.publish("/a", build("std_msgs/msg/UInt8MultiArray", data=b"\x00\xff7"))
        assert (await client.until(1))[0]["msg"]["data"] == base64.b64encode(b"\x00\xff7").decode()
        await client.say(op="unsubscribe", topic="/a")
        await client.say(op="subscribe", topic="/a", compression="cbor")
        graph.publish("/a", build("std_msgs/msg/UInt8MultiArray", data=b"\x00\xff7"))
        assert (await client.until(2))[1]["msg"]["data"] == b"\x00\xff7"

    play(scene)


def test_a_new_reader_gets_the_latest_of_a_latched_topic_alone() -> None:
    async def scene(graph: RosGraph, client: Client) -> None:
        graph.publish("/latched", _string("old"), latched=True)
        graph.publish("/latched", _string("kept"), latched=True)
        graph.publish("/passing", _string("gone"))
        await client.say(op="subscribe", topic="/passing")
        await client.say(op="subscribe", topic="/latched")
        assert [m["msg"]["data"] for m in await client.until(1)] == ["kept"]
        await client.stays_at(1)

    play(scene)


def test_throttling_sends_the_newest_and_no_more_often_than_asked() -> None:
    async def scene(graph: RosGraph, client: Client) -> None:
        await client.say(op="subscribe", topic="/a", type="std_msgs/msg/String", throttle_rate=200)
        begin = time.monotonic()
        for i in range(20):
            graph.publish("/a", _string(str(i)))
            await asyncio.sleep(0.01)
        while not client.sent or int(client.sent[-1]["msg"]["data"]) != 19:
            await client.until(len(client.sent) + 1)
        assert 2 <= len(client.sent) <= 1 + (time.monotonic() - begin) / 0.2

    play(scene)


def test_a_slow_reader_s_queue_keeps_the_newest_and_delays_nobody() -> None:
    async def scene(graph: RosGraph, client: Client) -> None:
        other = Client(graph)
        for one in (client, other):
            await one.say(op="subscribe", topic="/a", type="std_msgs/msg/String", queue_length=3)
        client.gate.clear()
        for i in range(30):
            graph.publish("/a", _string(str(i)))
            await other.until(i + 1)
        client.gate.set()
        await client.until(4)
        await asyncio.sleep(0.05)
        assert [int(m["msg"]["data"]) for m in client.sent] == [0, 27, 28, 29]
        await other.session.close()

    play(scene)


def test_subscriptions_of_one_topic_are_merged_and_left_one_by_one() -> None:
    async def scene(graph: RosGraph, client: Client) -> None:
        await client.say(op="subscribe", id="slow", topic="/a", type="std_msgs/msg/String", throttle_rate=60_000)
        await client.say(op="subscribe", id="fast", topic="/a", compression="cbor")
        for text in ("1", "2"):
            graph.publish("/a", _string(text))
        assert [m["msg"]["data"] for m in await client.until(2)] == ["1", "2"]
        await client.say(op="unsubscribe", id="slow", topic="/a")
        graph.publish("/a", _string("3"))
        await client.until(3)
        await client.say(op="unsubscribe", id="fast", topic="/a")
        graph.publish("/a", _string("4"))
        await client.stays_at(3)

    play(scene)


def test_fragments_are_sent_when_asked_for_and_put_together_when_received() -> None:
    async def scene(graph: RosGraph, client: Client) -> None:
        await client.say(op="subscribe", topic="/a", type="std_msgs/msg/String", fragment_size=200)
        graph.publish("/a", _string("x" * 1000))
        parts = await client.until(6)
        assert {part["op"] for part in parts} == {"fragment"}
        assert parts[0]["total"] == len(parts) == 6
        whole = json.loads("".join(part["data"] for part in sorted(parts, key=lambda p: p["num"])))
        assert whole["msg"]["data"] == "x" * 1000
        reader = graph.subscribe("/a", capacity=4)
        for part in random.Random(1).sample(parts, len(parts)):
            await client.say(**part)
        assert [m for m in client.sent if m["op"] == "status"] == []
        news = reader.get(1.0)
        assert news is not None
        assert news.value.message.data == "x" * 1000

    play(scene)


def test_what_a_client_publishes_reaches_others_with_ros_1_names_times_and_headers() -> None:
    async def scene(graph: RosGraph, client: Client) -> None:
        reader = graph.subscribe("/pose", capacity=4)
        await client.say(op="advertise", topic="/pose", type="geometry_msgs/PoseStamped")
        head = {"seq": 3, "stamp": {"secs": 5, "nsecs": 7}, "frame_id": "map"}
        pose = {"position": {"x": 1, "y": 2.5, "z": 0}, "orientation": {"w": 1}}
        await client.say(op="publish", topic="/pose", msg={"header": head, "pose": pose})
        news = reader.get(1.0)
        assert news is not None
        m = news.value.message
        assert (m.header.stamp.sec, m.header.stamp.nanosec, m.pose.position.y) == (5, 7, 2.5)
        assert news.value.client == client.session.number
        assert client.sent == []

    play(scene)


@pytest.mark.parametrize(
    ("operation", "told"),
    [
        ({"op": "dance"}, "operations are"),
        ({"op": "advertise", "topic": "/a", "type": "no/Such"}, "unknown"),
        ({"op": "advertise", "topic": "a b", "type": "std_msgs/String"}, "no name"),
        ({"op": "publish", "topic": "/unknown", "msg": {}}, "advertise it first"),
        ({"op": "publish", "topic": "/s", "msg": {"text": "a"}}, "no field 'text'"),
        ({"op": "publish", "topic": "/s", "msg": {"data": 3}}, "give text"),
        ({"op": "publish", "topic": "/i", "msg": {"data": 300}}, "out of range"),
        ({"op": "publish", "topic": "/i", "msg": {"data": "x"}}, "is"),
        ({"op": "subscribe", "topic": "/s", "type": "std_msgs/Int8"}, "is of type"),
        ({"op": "subscribe", "topic": "/s", "compression": "zip"}, "none, png, cbor"),
        ({"op": "subscribe", "topic": "/s", "fragment_size": 1}, "at least"),
        ({"op": "subscribe", "topic": "/s", "throttle_rate": -1}, "0 or more"),
        ({"op": "subscribe", "topic": "/*"}, "no name"),
        ({"op": "png", "data": "????"}, "PNG"),
        ({"op": "fragment", "id": "a", "num": 5, "total": 2, "data": ""}, "makes no sense"),
        ({"op": "set_level", "level": "loud"}, "none, error"),
    ],
)
def test_what_makes_no_sense_is_answered_by_a_status_that_says_why(operation: dict[str, Any], told: str) -> None:
    async def scene(graph: RosGraph, client: Client) -> None:
        graph.advertise("/s", "std_msgs/msg/String")
        graph.advertise("/i", "std_msgs/msg/Int8")
        await client.say(**operation, **({} if "id" in operation else {"id": "q"}))
        (status,) = client.sent
        assert (status["op"], status["level"], status["id"]) == ("status", "error", operation.get("id", "q"))
        assert told in status["msg"]
        await client.say(op="set_level", level="none")
        await client.say(**operation)
        assert len(client.sent) == 1

    play(scene)


def test_a_png_that_would_unpack_to_more_than_the_limit_is_refused_unopened() -> None:
    async def scene(_: RosGraph, client: Client) -> None:
        bomb = cv2.imencode(".png", np.zeros((2000, 2000, 3), np.uint8))[1].tobytes()
        assert len(bomb) < LIMIT
        await client.say(op="png", data=base64.b64encode(bomb).decode())
        assert "PNG" in client.sent[0]["msg"]

    play(scene)


def test_services_are_called_and_their_errors_are_told() -> None:
    def add(args: Any) -> dict[str, Any]:
        return {"sum": args["a"] + args["b"], "array": np.arange(3.0)}

    async def scene(graph: RosGraph, client: Client) -> None:
        graph.serve("/add", Service("test/srv/Add", add))
        await client.say(op="call_service", id="1", service="/add", args={"a": 1, "b": 2})
        answer = (await client.until(1))[0]
        assert (answer["id"], answer["result"], answer["values"]) == ("1", True, {"sum": 3, "array": [0.0, 1.0, 2.0]})
        await client.say(op="call_service", id="2", service="/none")
        assert (await client.until(2))[1]["result"] is False
        assert "no service /none" in client.sent[1]["values"]
        await client.say(op="call_service", id="3", service="/add", args={})
        answer = (await client.until(3))[2]
        assert (answer["id"], answer["result"]) == ("3", False)
        assert "its log says why" in answer["values"]

    play(scene)


def test_a_client_serves_another_until_it_leaves() -> None:
    async def scene(graph: RosGraph, client: Client) -> None:
        server = Client(graph)
        await server.say(op="advertise_service", service="/double", type="test/srv/Double")
        await client.say(op="call_service", id="1", service="/double", args={"x": 4})
        call = (await server.until(1))[0]
        await server.say(op="service_response", id=call["id"], values={"y": 2 * call["args"]["x"]}, result=True)
        assert (await client.until(1))[0]["values"] == {"y": 8}
        await client.say(op="call_service", id="2", service="/double", args={"x": 4})
        await server.until(2)
        await server.session.close()
        answer = (await client.until(2))[1]
        assert (answer["result"], "gone" in answer["values"]) == (False, True)
        assert "/double" not in graph.services

    play(scene)


def test_rosapi_names_topics_services_and_types() -> None:
    graph = RosGraph()
    RosApi(graph)
    graph.advertise("/odom", "nav_msgs/msg/Odometry")

    def call(name: str, **args: Any) -> dict[str, Any]:
        return graph.service(f"/rosapi/{name}").call(args)

    assert call("topics") == {"topics": ["/odom"], "types": ["nav_msgs/msg/Odometry"]}
    assert call("topic_type", topic="/odom")["type"] == "nav_msgs/msg/Odometry"
    assert call("topics_for_type", type="nav_msgs/Odometry")["topics"] == ["/odom"]
    assert call("service_type", service="/rosapi/topics")["type"] == "rosapi_msgs/srv/Topics"
    assert "MSG: geometry_msgs/Pose" in call("topics_and_raw_types")["typedefs_full_text"][0]
    kinds = {d["type"]: d for d in call("message_details", type="nav_msgs/Odometry")["typedefs"]}
    covariance = kinds["geometry_msgs/msg/PoseWithCovariance"]
    assert covariance["fieldarraylen"] == [-1, 36]
    time = call("get_time")["time"]
    assert time["secs"] == time["sec"] > 1.6e9


def test_two_thousand_damaged_messages_are_answered_and_nothing_breaks() -> None:
    seeds = [
        json.dumps(op)
        for op in (
            {"op": "subscribe", "topic": "/s", "compression": "png", "throttle_rate": 5, "queue_length": 2},
            {"op": "publish", "topic": "/j", "msg": {"name": ["a"], "position": [1.0, 2.0], "header": {"stamp": {}}}},
            {"op": "fragment", "id": "x", "num": 0, "total": 2, "data": "abc"},
            {"op": "call_service", "service": "/rosapi/topic_type", "args": {"topic": "/s"}, "id": "3"},
            {"op": "advertise", "topic": "/n", "type": "std_msgs/String"},
            {
                "op": "png",
                "data": "iVBORw0KGgoAAAANSUhEUgAAAAEAAAABCAIAAACQd1PeAAAADElEQVR4nGP4//8/AAX+Av4N70a4AAAAAElFTkSuQmCC",
            },
        )
    ]
    alphabet = '{}[]":,0123456789.eE-+nulltruefalse/\\ \x00é'

    async def scene(graph: RosGraph, client: Client) -> None:
        RosApi(graph)
        graph.advertise("/s", "std_msgs/msg/String")
        graph.advertise("/j", "sensor_msgs/msg/JointState")
        rng = random.Random(7)
        for i in range(2000):
            text = list(rng.choice(seeds))
            for _ in range(rng.randint(1, 6)):
                at = rng.randrange(len(text))
                text[at : at + rng.randint(0, 4)] = rng.choices(alphabet, k=rng.randint(0, 4))
            await client.session.receive("".join(text))
            if i % 100 == 0:
                await client.session.receive(bytes(rng.randrange(256) for _ in range(40)))
        await client.session.receive("[" * 50_000)
        await client.session.receive("x" * (LIMIT + 1))
        await asyncio.sleep(0.1)
        statuses = [m for m in client.sent if m.get("op") == "status"]
        assert len(statuses) > 800
        assert not any("its log says why" in m["msg"] for m in statuses)
        client.sent.clear()
        await client.say(op="call_service", id="alive", service="/rosapi/nodes")
        await client.until(1)
        assert any(m.get("id") == "alive" and m["result"] for m in client.sent)

    play(scene)

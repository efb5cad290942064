"""The Foxglove stream as a client decodes it that was first tried on the SDK's own server."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import InvalidHandshake
from websockets.sync.client import connect

from splatbot.logs.ros_types import definition, to_cdr
from splatbot.services.ros.messages import point_cloud_message, points_of
from splatbot.services.ros.publishers import POINTS
from tests.contracts.clients.foxglove_client import FoxgloveClient
from tests.contracts.conftest import Service, wall

CLOUD = "sensor_msgs/msg/PointCloud2"


def _check(cloud: Any) -> None:
    points = points_of(cloud)
    expected = wall().model
    np.testing.assert_array_equal(np.stack([points[a] for a in "xyz"], -1), expected.means.numpy())
    np.testing.assert_allclose(points["rgb"], expected.colors.numpy(), atol=0.5 / 255 + 1e-6)


def test_the_client_reads_our_messages_from_the_sdk_s_own_server() -> None:
    foxglove = pytest.importorskip("foxglove")
    schema = foxglove.Schema(name=CLOUD, encoding="ros2msg", data=definition(CLOUD).encode())
    context, received = foxglove.Context(), threading.Event()
    server = foxglove.start_server(port=0, context=context)
    try:
        channel = foxglove.Channel(POINTS, schema=schema, message_encoding="cdr", context=context)
        with FoxgloveClient(f"ws://127.0.0.1:{server.port}") as client:
            client.subscribe(POINTS)
            data = to_cdr(point_cloud_message(wall().model, 1.0))
            # The SDK drops messages that precede the subscription, whose arrival no status confirms: log repeatedly.
            logger = threading.Thread(target=lambda: _repeat(lambda: channel.log(data), until=received), daemon=True)
            logger.start()
            _check(client.message(POINTS)[1])
    finally:
        received.set()
        server.stop()


def _repeat(action: Callable[[], object], *, until: threading.Event) -> None:
    while not until.wait(0.05):
        action()


@pytest.mark.parametrize("subprotocol", ["foxglove.sdk.v1", "foxglove.websocket.v1"])
def test_the_map_is_read_by_the_same_client_from_our_server(subprotocol: str, service: Service) -> None:
    with FoxgloveClient(service.ws("/foxglove"), subprotocol) as client:
        client.subscribe(POINTS)
        stamp, cloud = client.message(POINTS)
        _check(cloud)
        assert stamp > 1.6e18
        assert client.info["supportedEncodings"] == ["cdr"]
        service.store.publish("wall", wall(2, z=2.0))
        assert points_of(client.message(POINTS)[1])["z"].max() == 2.0


def test_topics_that_come_later_are_advertised(service: Service) -> None:
    with FoxgloveClient(service.ws("/foxglove")) as client:
        client.subscribe(POINTS)
        _check(client.message(POINTS)[1])
        late = "/maps/late/map/points"
        assert late not in client.channels
        service.store.add("late", source="a", state="static", snapshot=wall())
        client.subscribe(late, number=8)
        _check(client.message(late, number=8)[1])


def test_what_makes_no_sense_is_told_and_the_connection_stays(service: Service) -> None:
    with FoxgloveClient(service.ws("/foxglove")) as client:
        client.say(op="subscribe", subscriptions=[{"id": 1, "channelId": 9999}])
        assert "no channel" in client.problem()
        client.say(op="subscribe", subscriptions="all")
        assert "subscriptions" in client.problem()
        client.say(op="advertise", channels=[])
        assert "not offered" in client.problem()
        client.subscribe(POINTS)
        _check(client.message(POINTS)[1])


def test_who_speaks_another_protocol_is_refused(service: Service) -> None:
    with pytest.raises(InvalidHandshake):
        connect(service.ws("/foxglove"))

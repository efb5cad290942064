"""One Foxglove client (foxglove/foxglove-sdk, WebSocket protocol v1): topics as CDR with their ros2msg definitions."""

from __future__ import annotations

import asyncio
import json
import logging
import secrets
import struct
from contextlib import suppress
from functools import partial
from typing import Any

from splatbot.errors import InputError
from splatbot.logs.ros_types import definition
from splatbot.services.bus import Subscription
from splatbot.services.ros.deliveries import Deliveries
from splatbot.services.ros.graph import RosGraph
from splatbot.services.ros.requests import read_json_object
from splatbot.services.ros.rosbridge.subscriptions import Send
from splatbot.services.ros.wire import RosMessage

SUBPROTOCOLS = ("foxglove.sdk.v1", "foxglove.websocket.v1")

_DATA = struct.Struct("<BIQ")  # opcode 1, subscription, time [ns]; then the message
_ERROR = 2
_WAITING = 16  # messages of one subscription
_MOST = 256  # subscriptions of one client
_LOOK_S = 0.5  # [s] between two looks for new topics

_log = logging.getLogger(__name__)


class FoxgloveSession:
    """Advertises every topic of a graph, also those to come, and sends those that are subscribed to.

    Args:
        graph: topics.
        send: takes text or bytes for the client; one at a time, and may wait.
        most_bytes: of one message of the client's.
    """

    def __init__(self, graph: RosGraph, send: Send, *, most_bytes: int) -> None:
        self._graph, self._to_client, self._most_bytes = graph, send, most_bytes
        self._sending = asyncio.Lock()
        self._channels: dict[str, int] = {}
        self._deliveries: Deliveries[int] = Deliveries(graph)
        self._watch: asyncio.Task[None] | None = None

    async def open(self) -> None:
        """Send the server's description to the client."""
        info = {"op": "serverInfo", "name": "splatbot", "capabilities": [], "supportedEncodings": ["cdr"]}
        await self._send(json.dumps(info | {"metadata": {"ROS_DISTRO": "jazzy"}, "sessionId": secrets.token_hex(8)}))
        await self._advertise()
        self._watch = asyncio.get_running_loop().create_task(self._look_for_topics())

    async def receive(self, text: str | bytes) -> None:
        """Handle a client's message; a wrong message never raises."""
        try:
            self._do(await read_json_object(text, self._most_bytes))
        except InputError as error:
            await self._status(_ERROR, str(error))

    async def close(self) -> None:
        """Forget the client."""
        await self._deliveries.close()
        if self._watch is not None:
            self._watch.cancel()
            with suppress(asyncio.CancelledError, Exception):
                await self._watch

    def _do(self, values: dict[str, Any]) -> None:
        if values.get("op") == "subscribe":
            for wish in _entries(values, "subscriptions", dict):
                self._subscribe(wish.get("id"), wish.get("channelId"))
        elif values.get("op") == "unsubscribe":
            for number in _entries(values, "subscriptionIds", int):
                self._deliveries.stop(number)
        else:
            hint = "the known operations are subscribe and unsubscribe"
            raise InputError(f"{str(values.get('op'))[:40]!r} is not offered.", field="op", hint=hint)

    def _subscribe(self, number: Any, channel: Any) -> None:
        topic = next((topic for topic, known in self._channels.items() if known == channel), None)
        if topic is None:
            raise InputError(f"no channel {str(channel)[:40]}.", field="channelId", hint="take an advertised one")
        fits = isinstance(number, int) and not isinstance(number, bool) and 0 <= number < 2**32
        if not fits or number in self._deliveries:
            raise InputError(f"is {str(number)[:40]}.", field="id", hint="give a new number for each subscription")
        if len(self._deliveries) >= _MOST:
            raise InputError("there are too many.", field="subscriptions", hint=f"at most {_MOST}")
        self._deliveries.start(number, topic, partial(self._deliver, number), capacity=_WAITING)

    async def _deliver(self, number: int, reader: Subscription, first: RosMessage | None) -> None:
        if first is not None:
            await self._one(number, first)
        while (news := await reader.receive()) is not None:
            if news.value is not first:
                await self._one(number, news.value)

    async def _one(self, number: int, message: RosMessage) -> None:
        try:
            data = await asyncio.to_thread(lambda: message.cdr)
        except Exception:  # one odd message must not end the topic
            _log.exception("a %s could not be sent", message.type)
            return
        await self._send(_DATA.pack(1, number, round(message.stamp * 1e9)) + data)

    async def _look_for_topics(self) -> None:
        while True:
            await asyncio.sleep(_LOOK_S)
            await self._advertise()

    async def _advertise(self) -> None:
        fresh = {topic: kind for topic, kind in self._graph.topics.items() if topic not in self._channels}
        channels = []
        for topic, kind in fresh.items():
            self._channels[topic] = len(self._channels) + 1
            schema = {"schemaName": kind, "schemaEncoding": "ros2msg", "schema": definition(kind)}
            channels.append({"id": self._channels[topic], "topic": topic, "encoding": "cdr", **schema})
        if channels:
            await self._send(json.dumps({"op": "advertise", "channels": channels}))

    async def _status(self, level: int, text: str) -> None:
        await self._send(json.dumps({"op": "status", "level": level, "message": text}))

    async def _send(self, data: str | bytes) -> None:
        async with self._sending:
            await self._to_client(data)


def _entries(values: dict[str, Any], key: str, kind: type) -> list[Any]:
    entries = values.get(key)
    if not isinstance(entries, list) or not all(isinstance(entry, kind) for entry in entries):
        raise InputError("makes no sense.", field=key, hint=f"give a list of {kind.__name__}")
    return entries

"""A small Foxglove client: it lists the advertised topics and decodes messages by their advertised definitions."""

from __future__ import annotations

import json
import struct
from types import TracebackType
from typing import Any

from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from websockets.sync.client import connect


class FoxgloveClient:
    """Connected to a server.

    Args:
        url: ws://HOST:PORT[/PATH].
        subprotocol: foxglove.sdk.v1 or foxglove.websocket.v1.
    """

    def __init__(self, url: str, subprotocol: str = "foxglove.sdk.v1") -> None:
        self._socket = connect(url, subprotocols=[subprotocol], max_size=None)  # type: ignore[list-item]
        assert self._socket.subprotocol == subprotocol
        self.info: dict[str, Any] = {}
        self.channels: dict[str, dict[str, Any]] = {}
        self.problems: list[str] = []
        self._data: list[tuple[int, int, bytes]] = []

    def subscribe(self, topic: str, number: int = 7) -> None:
        """Read a topic once it is advertised."""
        while topic not in self.channels:
            self._read()
        wish = {"id": number, "channelId": self.channels[topic]["id"]}
        self.say(op="subscribe", subscriptions=[wish])

    def say(self, **values: Any) -> None:
        """Send an operation."""
        self._socket.send(json.dumps(values))

    def problem(self) -> str:
        """Wait for the next status that the server sends."""
        while not self.problems:
            self._read()
        return self.problems.pop(0)

    def message(self, topic: str, number: int = 7) -> tuple[int, Any]:
        """Time [ns] and the next message of a subscription, decoded by the channel's own definition."""
        while not self._data:
            self._read()
        subscription, stamp, data = self._data.pop(0)
        assert subscription == number
        channel = self.channels[topic]
        assert (channel["encoding"], channel["schemaEncoding"]) == ("cdr", "ros2msg")
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(channel["schema"], channel["schemaName"]))
        return stamp, store.deserialize_cdr(data, channel["schemaName"])

    def _read(self) -> None:
        got = self._socket.recv(timeout=20)
        if isinstance(got, bytes):
            opcode, subscription, stamp = struct.unpack_from("<BIQ", got)
            assert opcode == 1
            self._data.append((subscription, stamp, got[13:]))
            return
        values = json.loads(got)
        if values["op"] == "serverInfo":
            self.info = values
        elif values["op"] == "advertise":
            self.channels |= {channel["topic"]: channel for channel in values["channels"]}
        elif values["op"] == "status":
            self.problems.append(values["message"])

    def __enter__(self) -> FoxgloveClient:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: object, trace: TracebackType | None) -> None:
        self._socket.close()

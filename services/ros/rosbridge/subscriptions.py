"""One client's subscriptions: those of a topic are merged, throttled, queued and packed."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from functools import partial
from typing import Any

from splatbot.errors import InputError
from splatbot.logs.ros_types import full_name
from splatbot.services.bus import Subscription
from splatbot.services.ros.deliveries import Deliveries
from splatbot.services.ros.graph import RosGraph, resolve
from splatbot.services.ros.rosbridge.packing import (
    Compression,
    check_compression,
    check_fragment_size,
    pack_published,
    split,
)
from splatbot.services.ros.wire import RosMessage

Send = Callable[[str | bytes], Awaitable[None]]

_UNTHROTTLED = 16  # messages that may wait where the client names no queue
_LONGEST_QUEUE = 1000
_MOST_OF_TOPIC = 64  # subscriptions that one client may have of one topic
_STRONGEST: tuple[Compression, ...] = ("cbor-raw", "cbor", "png", "none")

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class _SubscribeOptions:
    """Options of one `subscribe`: ``throttle`` [s], and ``queue``, which is 0 by default."""

    throttle: float
    queue: int
    fragment: int | None
    compression: Compression


class Subscriptions:
    """Topics that one client reads.

    Several subscriptions of a topic are one: the shortest throttle, the longest queue, the smallest fragment, the
    strongest compression.

    Args:
        graph: where the topics are.
        send: sends a message to the client; may wait.
        client: number of the client.
        most: topics at once.
    """

    def __init__(self, graph: RosGraph, send: Send, client: int, most: int = 256) -> None:
        self._graph, self._send, self._client, self._most = graph, send, client, most
        self._wishes: dict[str, dict[Any, _SubscribeOptions]] = {}
        self._deliveries: Deliveries[str] = Deliveries(graph)

    @property
    def topics(self) -> tuple[str, ...]:
        """Those that are read."""
        return tuple(self._wishes)

    def add(self, operation: dict[str, Any]) -> None:
        """Take a `subscribe`.

        Raises:
            InputError: the topic, its type or an option makes no sense.
        """
        topic = resolve(operation.get("topic"))
        wish = _SubscribeOptions(
            throttle=_number(operation, "throttle_rate") / 1000.0,
            queue=min(int(_number(operation, "queue_length")), _LONGEST_QUEUE),
            fragment=check_fragment_size(operation.get("fragment_size")),
            compression=check_compression(operation.get("compression") or "none"),
        )
        if kind := operation.get("type"):
            known = self._graph.topics.get(topic)
            if known is not None and full_name(str(kind)) != known:
                raise InputError(f"{topic} is of type {known}.", field="type", hint="subscribe with that type")
            self._graph.advertise(topic, str(kind), client=self._client)
        if topic not in self._wishes and len(self._wishes) >= self._most:
            raise InputError(f"{topic} is one topic too many.", field="topic", hint=f"read at most {self._most}")
        if len(self._wishes.get(topic, {})) >= _MOST_OF_TOPIC and _key(operation) not in self._wishes[topic]:
            hint = f"read it at most {_MOST_OF_TOPIC} times, or unsubscribe"
            raise InputError(f"{topic} has one subscription too many.", field="id", hint=hint)
        fresh = _key(operation) not in self._wishes.get(topic, {})
        self._wishes.setdefault(topic, {})[_key(operation)] = wish
        self._restart(topic, latched=fresh)

    def remove(self, operation: dict[str, Any]) -> None:
        """Take an `unsubscribe`: of one subscription by its id, or of all of the topic.

        Raises:
            InputError: the topic is malformed.
        """
        topic = resolve(operation.get("topic"))
        wishes = self._wishes.get(topic, {})
        if operation.get("id") is None:
            wishes.clear()
        wishes.pop(_key(operation), None)
        if wishes:
            self._restart(topic, latched=False)
        else:
            self._wishes.pop(topic, None)
            self._deliveries.stop(topic)

    async def close(self) -> None:
        """Read nothing any more."""
        await self._deliveries.close()

    def _restart(self, topic: str, *, latched: bool) -> None:
        self._deliveries.stop(topic)
        wishes = list(self._wishes[topic].values())
        merged = _SubscribeOptions(
            throttle=min(w.throttle for w in wishes),
            queue=max(w.queue for w in wishes),
            fragment=min((w.fragment for w in wishes if w.fragment is not None), default=None),
            compression=next(c for c in _STRONGEST if any(w.compression == c for w in wishes)),
        )
        capacity = merged.queue or (1 if merged.throttle else _UNTHROTTLED)
        deliver = partial(self._deliver, topic, merged)
        self._deliveries.start(topic, topic, deliver, capacity=capacity, latched=latched)

    async def _deliver(
        self, topic: str, wish: _SubscribeOptions, reader: Subscription, first: RosMessage | None
    ) -> None:
        loop = asyncio.get_running_loop()
        if first is not None:
            await self._one(topic, first, wish)
        while (news := await reader.receive()) is not None:
            begun = loop.time()
            if news.value is not first:
                await self._one(topic, news.value, wish)
                await asyncio.sleep(max(begun + wish.throttle - loop.time(), 0.0))

    async def _one(self, topic: str, message: RosMessage, wish: _SubscribeOptions) -> None:
        try:
            packed = await asyncio.to_thread(pack_published, topic, message, wish.compression)
        except Exception:  # one odd message must not end the topic
            _log.exception("%s could not be sent", topic)
            return
        if isinstance(packed, bytes):  # binary messages are never in fragments
            await self._send(packed)
            return
        for part in split(packed, wish.fragment, f"{topic} {id(message)}"):
            await self._send(part)


def _key(operation: dict[str, Any]) -> str:
    return str(operation.get("id"))[:256]


def _number(operation: dict[str, Any], key: str) -> float:
    value = operation.get(key) or 0
    if isinstance(value, bool) or not isinstance(value, int | float) or not 0 <= value < 1e9:
        raise InputError(f"is {str(value)[:40]!r}.", field=key, hint="give a number, 0 or more")
    return float(value)

"""Tasks that deliver topics of the graph to one client."""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from contextlib import suppress
from typing import Any, Generic, TypeVar

from splatbot.services.bus import Subscription
from splatbot.services.ros.graph import RosGraph
from splatbot.services.ros.wire import RosMessage

Key = TypeVar("Key")

# Arguments: the reader of a topic, and the topic's latched message, which the reader may deliver again.
Deliver = Callable[[Subscription, RosMessage | None], Coroutine[Any, Any, None]]


class Deliveries(Generic[Key]):
    """Running deliveries by key, each with the reader of its topic.

    Args:
        graph: topics.
    """

    def __init__(self, graph: RosGraph) -> None:
        self._graph = graph
        self._tasks: dict[Key, tuple[asyncio.Task[None], Subscription]] = {}

    def __len__(self) -> int:
        return len(self._tasks)

    def __contains__(self, key: Key) -> bool:
        return key in self._tasks

    def start(self, key: Key, topic: str, deliver: Deliver, *, capacity: int, latched: bool = True) -> None:
        """Start a delivery.

        Args:
            key: a key without a running delivery.
            topic: topic to read.
            deliver: reads until the reader ends.
            capacity: number of messages that may wait.
            latched: whether the latched message is delivered.
        """
        reader = self._graph.subscribe(topic, capacity=capacity)
        first = self._graph.latched(topic) if latched else None
        self._tasks[key] = asyncio.get_running_loop().create_task(deliver(reader, first)), reader

    def stop(self, key: Key) -> None:
        """Stop a delivery; without effect for an unknown key."""
        task, reader = self._tasks.pop(key, (None, None))
        if task is not None and reader is not None:
            reader.close()
            task.cancel()

    async def close(self) -> None:
        """Stop all deliveries and wait for their ends."""
        tasks = [task for task, _ in self._tasks.values()]
        for key in list(self._tasks):
            self.stop(key)
        for task in tasks:
            with suppress(asyncio.CancelledError, Exception):
                await task

"""News inside the process: the latest value of each topic, and bounded queues that never make a writer wait."""

from __future__ import annotations

import asyncio
import threading
import time
from collections import deque
from collections.abc import AsyncIterator, Iterator
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from fnmatch import fnmatchcase
from types import TracebackType
from typing import Any


@dataclass(frozen=True)
class Message:
    """One value of one topic.

    Args:
        topic: e.g. "maps/default/result"; :mod:`splatbot.services.topics` lists them.
        value: immutable.
        number: number of the message in its topic, from 1; a gap shows a reader that it has missed messages.
        time: when it was published, Unix time [s].
    """

    topic: str
    value: Any = field(repr=False)
    number: int
    time: float


class Subscription(AbstractContextManager["Subscription"]):
    """Queue of unread messages, oldest first; when it is full, the oldest is dropped and counted.

    Read from a thread (:meth:`get`, iteration) or from asyncio (:meth:`receive`, ``async for``); closing ends both.
    """

    def __init__(self, bus: Bus, patterns: tuple[str, ...], capacity: int) -> None:
        self._bus = bus
        self._patterns = patterns
        self._queue: deque[Message] = deque(maxlen=capacity)
        self._changed = threading.Condition()
        self._waiting: list[tuple[asyncio.AbstractEventLoop, asyncio.Event]] = []
        self._closed = False
        self._dropped: dict[str, int] = {}

    @property
    def dropped(self) -> dict[str, int]:
        """How many messages of each topic had to make room."""
        with self._changed:
            return dict(self._dropped)

    def wants(self, topic: str) -> bool:
        """Return True if a topic is subscribed to."""
        return any(fnmatchcase(topic, pattern) for pattern in self._patterns)

    def get(self, timeout_s: float | None = None) -> Message | None:
        """Return the next message, or None once closed or after ``timeout_s`` [s]. Block the calling thread."""
        with self._changed:
            self._changed.wait_for(lambda: self._queue or self._closed, timeout_s)
            return self._take()

    async def receive(self) -> Message | None:
        """Return the next message, or None once closed. Wait without blocking the event loop."""
        while True:
            news = asyncio.Event()
            waiter = asyncio.get_running_loop(), news
            with self._changed:
                if self._queue or self._closed:
                    return self._take()
                self._waiting.append(waiter)
            try:
                await news.wait()
            finally:
                with self._changed:
                    if waiter in self._waiting:
                        self._waiting.remove(waiter)

    def close(self) -> None:
        """Leave the bus; waiting readers receive None."""
        self._bus._leave(self)
        with self._changed:
            self._closed = True
            self._queue.clear()
            self._wake()

    def __iter__(self) -> Iterator[Message]:
        while (message := self.get()) is not None:
            yield message

    async def __aiter__(self) -> AsyncIterator[Message]:
        while (message := await self.receive()) is not None:
            yield message

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.close()

    def _offer(self, message: Message) -> str | None:
        """Queue a message; the topic of the one that made room for it."""
        with self._changed:
            lost = self._queue[0].topic if len(self._queue) == self._queue.maxlen else None
            if lost is not None:
                self._dropped[lost] = self._dropped.get(lost, 0) + 1
            self._queue.append(message)
            self._wake()
        return lost

    def _take(self) -> Message | None:
        return self._queue.popleft() if self._queue else None

    def _wake(self) -> None:
        self._changed.notify_all()
        for loop, news in self._waiting:
            if not loop.is_closed():
                loop.call_soon_threadsafe(news.set)
        self._waiting.clear()


class Bus:
    """Topics of one process. Publishing takes microseconds and does not depend on the readers."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._latest: dict[str, Message] = {}
        self._numbers: dict[str, int] = {}
        self._readers: list[Subscription] = []
        self._dropped: dict[str, int] = {}
        self._closed = False

    def publish(self, topic: str, value: Any, *, keep: bool = True) -> None:
        """Queue ``value`` for the topic's readers, and keep it as the topic's latest."""
        with self._lock:
            number = self._numbers[topic] = self._numbers.get(topic, 0) + 1
            message = Message(topic, value, number, time.time())
            if keep:
                self._latest[topic] = message
            else:
                self._latest.pop(topic, None)
            for reader in self._readers:
                if reader.wants(topic) and (lost := reader._offer(message)) is not None:
                    self._dropped[lost] = self._dropped.get(lost, 0) + 1

    def latest(self, topic: str) -> Message | None:
        """Return the topic's latest message, or None before the first."""
        with self._lock:
            return self._latest.get(topic)

    def topics(self) -> tuple[str, ...]:
        """Return the topics that have a message, in the order of their first."""
        with self._lock:
            return tuple(self._latest)

    def subscribe(self, *patterns: str, capacity: int = 16, latched: bool = True) -> Subscription:
        """Read the topics that match any of the patterns (as of a shell: "maps/*/result"), those to come as well.

        Args:
            capacity: messages that may wait.
            latched: begin with the latest message of each topic.

        Raises:
            ValueError: the capacity is less than 1.
        """
        if capacity < 1:
            raise ValueError(f"capacity is {capacity}, must be at least 1")
        reader = Subscription(self, patterns, capacity)
        with self._lock:
            if latched:
                for message in self._latest.values():
                    if reader.wants(message.topic):
                        reader._offer(message)
            self._readers.append(reader)
            closed = self._closed
        if closed:
            reader.close()
        return reader

    def forget(self, prefix: str) -> None:
        """Drop the latest messages of all topics that begin with ``prefix``, e.g. "maps/desk/"."""
        with self._lock:
            for topic in [topic for topic in self._numbers if topic.startswith(prefix)]:
                self._latest.pop(topic, None)
                del self._numbers[topic]
            for topic in [topic for topic in self._dropped if topic.startswith(prefix)]:
                first, _, *rest = topic.split("/")
                kind = "/".join([first, "*", *rest])
                self._dropped[kind] = self._dropped.get(kind, 0) + self._dropped.pop(topic)

    def forget_topic(self, topic: str) -> None:
        """Drop the latest message of one topic."""
        with self._lock:
            self._latest.pop(topic, None)
            self._numbers.pop(topic, None)

    @property
    def dropped(self) -> dict[str, int]:
        """How many messages of each topic readers were too slow for, since the start."""
        with self._lock:
            return dict(self._dropped)

    @property
    def readers(self) -> int:
        """How many subscriptions are open."""
        with self._lock:
            return len(self._readers)

    def readers_of(self, topic: str) -> frozenset[Subscription]:
        """Return the open subscriptions that receive the messages of a topic."""
        with self._lock:
            return frozenset(reader for reader in self._readers if reader.wants(topic))

    def close(self) -> None:
        """End every subscription, present and future; later messages have no readers."""
        with self._lock:
            self._closed = True
            readers = list(self._readers)
        for reader in readers:
            reader.close()

    def _leave(self, reader: Subscription) -> None:
        with self._lock:
            if reader in self._readers:
                self._readers.remove(reader)

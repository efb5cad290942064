"""Topics and services by their ROS names, which every transport (rosbridge, Foxglove, the recorder) shares."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from splatbot.errors import InputError, SplatbotError
from splatbot.logs.ros_types import Message, full_name, type_of
from splatbot.services.bus import Bus, Subscription
from splatbot.services.ros.wire import RosMessage

Handler = Callable[[Mapping[str, Any]], dict[str, Any]]

_NAME = re.compile(r"/[A-Za-z_][A-Za-z0-9_/]*")
_LONGEST = 256
_MOST_TOPICS = 256  # that clients may add: each keeps a latest message


class UnknownServiceError(SplatbotError):
    """No service of that name."""

    http_status = 404


@dataclass(frozen=True)
class Service:
    """A service that clients can call.

    Args:
        type: `pkg/srv/Name`.
        call: takes the request as nested dictionaries, and may take its time: it runs in a thread.
        client: number of the connection that serves it; 0: the service itself.
    """

    type: str
    call: Handler
    client: int = 0


class RosGraph:
    """Registry of topics and services, as a ROS master keeps it. All methods may be called from any thread."""

    def __init__(self) -> None:
        self._bus = Bus()
        self._lock = threading.Lock()
        self._types: dict[str, str] = {}
        self._services: dict[str, Service] = {}
        self._on_leave: list[Callable[[int], None]] = []

    def advertise(self, topic: str, name: str) -> str:
        """Make a topic of a message type known; returns its name with a slash before it.

        Raises:
            InputError: the topic's name is malformed, the type unknown, or the topic of another type.
        """
        topic, kind = resolve(topic), full_name(name)
        with self._lock:
            known = self._types.get(topic)
            if known is None and len(self._types) >= _MOST_TOPICS:
                raise InputError(f"{topic} is one topic too many.", field="topic", hint=f"use at most {_MOST_TOPICS}")
            if known not in (None, kind):
                raise InputError(f"{topic} is of type {known}, not {kind}.", field="type", hint="use another topic")
            self._types[topic] = kind
        return topic

    def publish(self, topic: str, message: Message, *, latched: bool = False, client: int = 0) -> None:
        """Let the topic's readers have a message.

        Raises:
            InputError: as :meth:`advertise`.
        """
        kind = type_of(message)
        topic = self.advertise(topic, kind)
        self._bus.publish(topic, RosMessage(kind, lambda: message, time.time(), latched, client))

    def publish_later(self, topic: str, kind: str, make: Callable[[], Message], *, latched: bool = False) -> None:
        """Publish a message that is built only when a client reads it.

        Raises:
            InputError: as :meth:`advertise`.
        """
        self._bus.publish(self.advertise(topic, kind), RosMessage(kind, make, time.time(), latched))

    def subscribe(self, *topics: str, capacity: int) -> Subscription:
        """Read topics from now on (an empty list reads all); :meth:`latched` gives the earlier ones.

        Raises:
            InputError: a topic's name is malformed.
        """
        names = [resolve(topic) for topic in topics] or ["*"]
        return self._bus.subscribe(*names, capacity=max(capacity, 1), latched=False)

    def latched(self, topic: str) -> RosMessage | None:
        """Return the topic's latest message if the topic is latched."""
        found = self._bus.latest(resolve(topic))
        return found.value if found is not None and found.value.latched else None

    @property
    def topics(self) -> dict[str, str]:
        """Types by topic."""
        with self._lock:
            return dict(self._types)

    @property
    def services(self) -> dict[str, Service]:
        """Services by name."""
        with self._lock:
            return dict(self._services)

    @property
    def dropped(self) -> dict[str, int]:
        """How many messages of each topic readers were too slow for."""
        return self._bus.dropped

    def serve(self, name: str, service: Service) -> None:
        """Offer a service.

        Raises:
            InputError: the name is malformed or taken.
        """
        name = resolve(name)
        with self._lock:
            if name in self._services:
                raise InputError(f"{name} is served already.", field="service", hint="use another name")
            self._services[name] = service

    def withdraw(self, name: str, client: int) -> None:
        """Offer a service no longer; one of another client's is left alone."""
        with self._lock:
            found = self._services.get(resolve(name))
            if found is not None and found.client == client:
                del self._services[resolve(name)]

    def on_leave(self, call: Callable[[int], None]) -> None:
        """Register a function that is called with the number of each client that leaves."""
        with self._lock:
            self._on_leave.append(call)

    def leave(self, client: int) -> None:
        """Forget a client whose connection has ended."""
        with self._lock:
            calls = list(self._on_leave)
        for call in calls:
            call(client)

    def service(self, name: str) -> Service:
        """Return the service of that name.

        Raises:
            UnknownServiceError: the name is unknown.
        """
        with self._lock:
            found = self._services.get(resolve(name))
            known = ", ".join(sorted(self._services))
        if found is None:
            raise UnknownServiceError(f"no service {name[:_LONGEST]}.", field="service", hint=f"there are {known}")
        return found


def resolve(name: Any) -> str:
    """Return the full name of a topic or service.

    Raises:
        InputError: it is malformed.
    """
    full = name if isinstance(name, str) and name.startswith("/") else f"/{name}"
    if not isinstance(name, str) or len(full) > _LONGEST or not _NAME.fullmatch(full):
        raise InputError(f"{str(name)[:80]!r} is no name.", field="name", hint="write /like/this_1")
    return full

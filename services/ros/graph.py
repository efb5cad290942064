"""Topics and services by their ROS names, which every transport (rosbridge, Foxglove, the recorder) shares."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any

from splatbot.errors import InputError, SplatbotError
from splatbot.logs.ros_types import Message, full_name, type_of, typestore
from splatbot.services.bus import Bus, Subscription
from splatbot.services.ros.wire import RosMessage

Handler = Callable[[Mapping[str, Any]], dict[str, Any]]

_NAME = re.compile(r"/[A-Za-z_][A-Za-z0-9_/]*")
_LONGEST = 256
MOST_TOPICS = 512  # of all clients
CLIENT_TOPICS = 64
CLIENT_SERVICES = 32
CLIENT_RETAINED_BYTES = 8 * 2**20  # latched messages of one client, in CDR


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
        quick: the call takes less than a millisecond; it does not wait behind others.
    """

    type: str
    call: Handler
    client: int = 0
    quick: bool = False


Command = Callable[[Message, int], None]
"""Called with a published message and the number of its client."""


class RosGraph:
    """Registry of topics and services, as a ROS master keeps it. All methods may be called from any thread."""

    def __init__(self) -> None:
        self._bus = Bus()
        self._lock = threading.Lock()
        self._types: dict[str, str] = {}
        self._users: dict[str, set[int]] = {}
        self._retained: dict[str, tuple[int, int]] = {}
        self._commands: dict[str, tuple[tuple[str, ...], Command]] = {}
        self._services: dict[str, Service] = {}
        self._clients: set[int] = set()
        self._on_leave: list[Callable[[int], None]] = []

    def advertise(self, topic: str, name: str, *, client: int = 0) -> str:
        """Make a topic of a message type known; returns its name with a slash before it.

        A client's topic is removed when the last client that uses it has left.

        Raises:
            InputError: the topic's name is malformed, the type unknown, the topic of another type, or one too many.
        """
        topic, kind = resolve(topic), full_name(name)
        with self._lock:
            if topic in self._commands and kind in self._commands[topic][0]:
                return topic
            known = self._types.get(topic)
            if known not in (None, kind):
                raise InputError(f"{topic} is of type {known}, not {kind}.", field="type", hint="use another topic")
            users = self._users.get(topic, set())
            if client and client not in users and 0 not in users:
                self._check_quota(topic, client)
            self._types[topic] = kind
            self._users.setdefault(topic, set()).add(client)
        return topic

    def _check_quota(self, topic: str, client: int) -> None:
        """Check that a client may use another topic."""
        own = sum(client in users for users in self._users.values())
        of_clients = sum(0 not in users for users in self._users.values())
        if own >= CLIENT_TOPICS or (topic not in self._types and of_clients >= MOST_TOPICS):
            hint = f"use at most {CLIENT_TOPICS}"
            raise InputError(f"{topic} is one topic too many.", field="topic", hint=hint)

    def unadvertise(self, topic: str, client: int) -> None:
        """Let a client use a topic no longer; its last user takes the topic along."""
        with self._lock:
            self._leave_topic(resolve(topic), client)

    def _leave_topic(self, topic: str, client: int) -> None:
        users = self._users.get(topic, set())
        users.discard(client)
        if not users and topic in self._users:
            self._drop(topic)

    def _drop(self, topic: str) -> None:
        del self._users[topic], self._types[topic]
        self._retained.pop(topic, None)
        self._bus.forget_topic(topic)

    def remove_topics(self, prefix: str) -> None:
        """Remove all topics of the service that begin with ``prefix``; those that clients use too are theirs."""
        with self._lock:
            for topic in [topic for topic in self._types if topic.startswith(prefix)]:
                self._leave_topic(topic, 0)

    def unlatch(self, topic: str) -> None:
        """Drop the topic's latched message."""
        self._bus.forget_topic(topic)

    def on_command(self, topic: str, kinds: tuple[str, ...], call: Command) -> None:
        """Register a function that is called at once for each message of a topic.

        Args:
            topic: name of the topic; its type is the first of ``kinds``.
            kinds: types that the topic takes.
            call: never waits.
        """
        topic = self.advertise(topic, kinds[0])
        with self._lock:
            self._commands[topic] = kinds, call

    def kind_of(self, topic: str, values: Mapping[str, Any]) -> str | None:
        """Return the type of a message that was not advertised: of the topic's types, the first with its fields."""
        with self._lock:
            kinds = self._commands[topic][0] if topic in self._commands else (self._types.get(topic),)
        return next((kind for kind in kinds if kind and set(values) <= fields_of(kind)), kinds[0])

    def publish(self, topic: str, message: Message, *, latched: bool = False, client: int = 0) -> None:
        """Let the topic's readers have a message.

        Raises:
            InputError: as :meth:`advertise`.
        """
        kind = type_of(message)
        topic = self.advertise(topic, kind, client=client)
        sent = RosMessage(kind, lambda: message, time.time(), latched, client)
        if client and latched:
            self._check_retained(topic, client, len(sent.cdr))
        if topic in self._commands:
            self._commands[topic][1](message, client)
        self._bus.publish(topic, sent, keep=latched)

    def _check_retained(self, topic: str, client: int, size: int) -> None:
        """Count the bytes of a client's latched message."""
        with self._lock:
            others = sum(n for known, (owner, n) in self._retained.items() if owner == client and known != topic)
            if others + size > CLIENT_RETAINED_BYTES:
                hint = f"latch at most {CLIENT_RETAINED_BYTES} bytes, or publish without latch"
                raise InputError(f"{topic} has {size} bytes too many to be kept.", field="latch", hint=hint)
            self._retained[topic] = client, size

    def publish_later(self, topic: str, kind: str, make: Callable[[], Message], *, latched: bool = False) -> None:
        """Publish a message that is built only when a client reads it.

        Raises:
            InputError: as :meth:`advertise`.
        """
        self._bus.publish(self.advertise(topic, kind), RosMessage(kind, make, time.time(), latched), keep=latched)

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
            own = sum(known.client == service.client for known in self._services.values())
            if service.client and own >= CLIENT_SERVICES:
                hint = f"offer at most {CLIENT_SERVICES}"
                raise InputError(f"{name} is one service too many.", field="service", hint=hint)
            if name in self._services:
                raise InputError(f"{name} is served already.", field="service", hint="use another name")
            self._services[name] = service

    def withdraw(self, name: str, client: int) -> None:
        """Offer a service no longer; one of another client's is left alone."""
        with self._lock:
            found = self._services.get(resolve(name))
            if found is not None and found.client == client:
                del self._services[resolve(name)]

    def join(self, client: int) -> None:
        """Note that a client is connected, until it leaves."""
        with self._lock:
            self._clients.add(client)

    def connected(self, client: int) -> bool:
        """Return whether a client is connected; 0 is the service itself."""
        with self._lock:
            return client == 0 or client in self._clients

    def has_clients(self, topic: str) -> bool:
        """Return whether a client uses a topic."""
        with self._lock:
            return bool(self._users.get(topic, set()) - {0})

    def readers_of(self, topic: str) -> frozenset[Subscription]:
        """Return the open subscriptions that receive the messages of a topic."""
        return self._bus.readers_of(topic)

    def on_leave(self, call: Callable[[int], None]) -> None:
        """Register a function that is called with the number of each client that leaves."""
        with self._lock:
            self._on_leave.append(call)

    def leave(self, client: int) -> None:
        """Forget a client whose connection has ended, and the topics that only it used."""
        with self._lock:
            self._clients.discard(client)
            calls = list(self._on_leave)
            for topic in [topic for topic, users in self._users.items() if client in users]:
                self._leave_topic(topic, client)
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


def fields_of(kind: str) -> set[str]:
    """Return the names of a type's fields."""
    return {name for name, _ in typestore().fielddefs[kind][1]} - {"structure_needs_at_least_one_member"}


def resolve(name: Any) -> str:
    """Return the full name of a topic or service.

    Raises:
        InputError: it is malformed.
    """
    full = name if isinstance(name, str) and name.startswith("/") else f"/{name}"
    if not isinstance(name, str) or len(full) > _LONGEST or not _NAME.fullmatch(full):
        raise InputError(f"{str(name)[:80]!r} is no name.", field="name", hint="write /like/this_1")
    return full

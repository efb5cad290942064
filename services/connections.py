"""Connections of clients: how many there may be, and how long a silent one stays open."""

from __future__ import annotations

import errno
import logging
import os
import resource
import socket
import time
from collections import Counter
from contextlib import suppress
from typing import Any

from uvicorn.protocols.http.h11_impl import H11Protocol

from splatbot.errors import InputError

_NO_FILES = (errno.EMFILE, errno.ENFILE)
_LOG_EVERY_S = 60.0
_FREED = 16  # connections that are closed when no file descriptors are left

_log = logging.getLogger(__name__)


class Connection(socket.socket):
    """One accepted connection.

    Attributes:
        client: address of the other side.
        idle_since: time on the clock of ``time.monotonic`` since which no request is in progress [s]; None during one.
    """

    owner: Connections | None = None
    client = ""
    idle_since: float | None = None

    def close(self) -> None:
        """Close the socket and forget the connection."""
        if self.owner is not None:
            self.owner.forget(self)
        super().close()


class Connections:
    """Open connections of a service. All methods run in the thread of its event loop.

    A connection that is one too many closes the oldest idle one: first of its own client, else of the client that has
    the most. Without an idle one it is closed itself.

    Args:
        most: connections at once.
        most_of_client: connections of one address.
        idle_s: time within which a request's headers must arrive [s].
        unread_s: time without progress after which the system ends a connection whose client does not read [s].
    """

    def __init__(self, most: int, most_of_client: int, idle_s: float, unread_s: float) -> None:
        self.most, self.most_of_client, self.idle_s, self.unread_s = most, most_of_client, idle_s, unread_s
        self._open: dict[int, Connection] = {}
        self._told = -_LOG_EVERY_S

    def __len__(self) -> int:
        return len(self._open)

    def add(self, connection: Connection, client: str) -> bool:
        """Count a new connection; returns False if it must be closed."""
        of_client = Counter(known.client for known in self._open.values())
        if of_client[client] >= self.most_of_client:
            crowded = client
        elif len(self._open) >= self.most:
            crowded = of_client.most_common(1)[0][0]
        else:
            crowded = ""
        if crowded and not self._close_idle(crowded):
            self._tell(f"{len(self._open)} connections are open, {of_client[client]} of {client}; one more was closed")
            return False
        connection.owner, connection.client, connection.idle_since = self, client, time.monotonic()
        self._open[connection.fileno()] = connection
        return True

    def forget(self, connection: Connection) -> None:
        """Count a connection no longer."""
        if self._open.get(connection.fileno()) is connection:
            del self._open[connection.fileno()]

    def mark(self, fd: int, *, busy: bool) -> None:
        """Note that a request has begun or has been answered on the connection of a file descriptor."""
        if (connection := self._open.get(fd)) is not None:
            connection.idle_since = None if busy else time.monotonic()

    def close_silent(self) -> None:
        """Close connections whose next request has not come in time, for instance in the midst of its headers."""
        before = time.monotonic() - self.idle_s
        for connection in list(self._open.values()):
            if connection.idle_since is not None and connection.idle_since < before:
                _hang_up(connection)

    def out_of_files(self) -> bool:
        """Close idle connections because the process has no file descriptors left; return whether there was one."""
        self._tell(f"no file descriptors are left at {len(self._open)} connections; idle and new ones are closed")
        for number in range(_FREED):
            of_client = Counter(known.client for known in self._open.values() if known.idle_since is not None)
            if not of_client:
                return number > 0
            self._close_idle(of_client.most_common(1)[0][0])
        return True

    def _close_idle(self, client: str) -> bool:
        idle = [known for known in self._open.values() if known.client == client and known.idle_since is not None]
        if idle:
            oldest = min(idle, key=lambda known: known.idle_since or 0.0)
            self.forget(oldest)
            _hang_up(oldest)
        return bool(idle)

    def _tell(self, text: str) -> None:
        if time.monotonic() - self._told >= _LOG_EVERY_S:
            self._told = time.monotonic()
            _log.warning("%s", text)


class Listener(socket.socket):
    """Listening socket that counts its connections and keeps a file descriptor for the case that none is left.

    asyncio answers EMFILE by 2,048 log lines and as many retries; here idle connections make room, and without one
    the new connection is closed.

    Args:
        connections: counts them.
        family: AF_INET or AF_INET6.
    """

    def __init__(self, connections: Connections, family: int) -> None:
        # Named as TCP, else asyncio leaves Nagle's algorithm on and each answer waits 40 ms for the client's ACK.
        super().__init__(family, socket.SOCK_STREAM, socket.IPPROTO_TCP)
        self._connections = connections
        self._reserve = os.open(os.devnull, os.O_RDONLY)

    def accept(self) -> tuple[socket.socket, Any]:
        """Return the next connection that may stay open, and its address."""
        while True:
            try:
                fd, address = self._accept()  # type: ignore[attr-defined]
            except OSError as error:
                if error.errno not in _NO_FILES:
                    raise
                if self._connections.out_of_files():
                    raise BlockingIOError from error  # asyncio accepts again once those are closed
                self._refuse_one()
                continue
            connection = Connection(self.family, self.type, self.proto, fileno=fd)
            if hasattr(socket, "TCP_USER_TIMEOUT"):  # Linux
                unread_ms = round(1e3 * self._connections.unread_s)
                connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_USER_TIMEOUT, unread_ms)
            if self._connections.add(connection, str(address[0])):
                return connection, address
            connection.close()

    def close(self) -> None:
        """Close the socket and the descriptor that it keeps."""
        if self._reserve >= 0:
            os.close(self._reserve)
            self._reserve = -1
        super().close()

    def _refuse_one(self) -> None:
        """Close the oldest waiting connection, for which the kept file descriptor is freed."""
        os.close(self._reserve)
        self._reserve = -1
        try:
            os.close(self._accept()[0])  # type: ignore[attr-defined]
        finally:
            self._reserve = os.open(os.devnull, os.O_RDONLY)


def listen(host: str, port: int, connections: Connections) -> Listener:
    """Open a listening socket.

    Raises:
        InputError: the address cannot be listened on.
    """
    listener = Listener(connections, socket.AF_INET6 if ":" in host else socket.AF_INET)
    listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
    try:
        listener.bind((host, port))
        listener.listen(2048)  # now, so that early clients wait for the application instead of being refused
    except OSError as error:
        listener.close()
        raise InputError(
            f"cannot listen on {host} port {port} ({error.strerror}).",
            field="port",
            hint="give another --host or --port",
        ) from error
    return listener


class HttpProtocol(H11Protocol):
    """uvicorn's HTTP/1.1, which notes the begin and the end of requests.

    Args:
        connections: counts them.
        arguments: of uvicorn's.
    """

    def __init__(self, *, connections: Connections, **arguments: Any) -> None:
        super().__init__(**arguments)
        self._connections = connections

    def handle_events(self) -> None:
        """Handle received data; complete headers begin a request."""
        super().handle_events()
        if self.cycle is not None and not self.cycle.response_complete:
            self._mark(busy=True)

    def handle_websocket_upgrade(self, event: Any) -> None:
        """Pass the connection to a WebSocket, whose pings detect a silent client."""
        super().handle_websocket_upgrade(event)
        self._mark(busy=True)

    def on_response_complete(self) -> None:
        """Wait for the next request."""
        self._mark(busy=False)
        super().on_response_complete()

    def _mark(self, *, busy: bool) -> None:
        line = self.transport.get_extra_info("socket")
        if line is not None:
            self._connections.mark(line.fileno(), busy=busy)


def raise_file_limit(wanted: int) -> int:
    """Raise the limit of open files to ``wanted`` where the system lets it, and return the limit."""
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    if soft < wanted:
        soft = wanted if hard == resource.RLIM_INFINITY else min(wanted, hard)
        with suppress(OSError, ValueError):
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
    return resource.getrlimit(resource.RLIMIT_NOFILE)[0]


def _hang_up(connection: Connection) -> None:
    """End a connection; the event loop then reads its end and closes it."""
    connection.idle_since = None
    with suppress(OSError):
        connection.shutdown(socket.SHUT_RDWR)

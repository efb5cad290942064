"""A rosbridge server on a free port of this machine: its connections, and a thread that lives through ticks."""

from __future__ import annotations

import json
import threading
import time
from abc import ABC, abstractmethod
from contextlib import suppress
from typing import Any, Self

from websockets.exceptions import WebSocketException
from websockets.sync.server import Server, ServerConnection, serve


class FakeRosbridge(ABC):
    """Base of robots behind rosbridge.

    Args:
        period: of the ticks [s].

    Attributes:
        port: of the server.
    """

    def __init__(self, period: float) -> None:
        self._period = period
        self._sockets: dict[ServerConnection, set[str]] = {}
        self._lock = threading.RLock()
        self._ended = threading.Event()
        self._server = self._serve(0)
        self.port = int(self._server.socket.getsockname()[1])
        self._thread = threading.Thread(target=self._live, daemon=True)
        self._thread.start()

    @property
    def address(self) -> str:
        return f"ws://127.0.0.1:{self.port}"

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self._cut()

    def say(self, text: str) -> None:
        """Send a text to all clients."""
        with self._lock:
            for socket in self._sockets:
                self._send(socket, text)

    @abstractmethod
    def _take(self, socket: ServerConnection, operation: dict[str, Any]) -> None:
        """Execute an operation of a client."""

    @abstractmethod
    def _tick(self, ticks: int) -> None:
        """Advance the robot by a period; the lock is held."""

    def _live(self) -> None:
        ticks = 0
        while not self._ended.wait(self._period):
            ticks += 1
            with self._lock:
                self._tick(ticks)

    def _serve(self, port: int) -> Server:
        server = serve(self._talk, "127.0.0.1", port, max_size=None)
        threading.Thread(target=server.serve_forever, daemon=True).start()
        return server

    def _talk(self, socket: ServerConnection) -> None:
        with self._lock:
            self._sockets[socket] = set()
        with suppress(WebSocketException, OSError):
            for text in socket:
                operation = json.loads(text)
                if operation["op"] == "subscribe":
                    self._sockets[socket].add(operation["topic"])
                else:
                    self._take(socket, operation)
        with self._lock:
            del self._sockets[socket]

    def _cut(self) -> None:
        self._server.shutdown()
        with self._lock:
            sockets = list(self._sockets)
        for socket in sockets:
            with suppress(OSError):
                socket.socket.shutdown(2)

    def _restart(self, down_s: float) -> None:
        """Cut all connections in another thread, and serve again after a time [s]."""

        def restart() -> None:
            self._cut()
            time.sleep(down_s)
            if not self._ended.is_set():
                self._server = self._serve(self.port)

        threading.Thread(target=restart, daemon=True).start()

    def _publish(self, topic: str, message: dict[str, Any]) -> None:
        text = json.dumps({"op": "publish", "topic": topic, "msg": message})
        for socket, topics in self._sockets.items():
            if topic in topics:
                self._send(socket, text)

    def _send(self, socket: ServerConnection, text: str) -> None:
        with suppress(WebSocketException, OSError):
            socket.send(text)

"""A connection to a rosbridge server that is opened again when it is lost (rosbridge protocol 2, RobotWebTools)."""

from __future__ import annotations

import json
import logging
import threading
from collections.abc import Callable, Iterable
from contextlib import suppress
from typing import Any

from websockets.exceptions import InvalidURI, WebSocketException
from websockets.sync.client import ClientConnection, connect

from splatbot.errors import DeviceError, InputError

Operation = dict[str, Any]

_MAX_MESSAGE = 2**20  # [bytes] of a message from the server
_OPEN_S = 3.0
_RETRY_S = 0.2

_log = logging.getLogger(__name__)


class RosbridgeLink:
    """One WebSocket to a rosbridge server, read in a thread of its own.

    Args:
        address: ``ws://host:port`` or ``wss://host:port``.
        greet: returns the operations to send each time the connection opens.
        take: called with each operation of the server, in the thread.

    Raises:
        InputError: the address is malformed.
        DeviceError: nothing answers at the address.

    Attributes:
        losses: how often the connection was lost.
    """

    def __init__(
        self, address: str, greet: Callable[[], Iterable[Operation]], take: Callable[[Operation], None]
    ) -> None:
        self._address, self._greet, self._take = address, greet, take
        self.losses = 0
        self._ended = threading.Event()
        self._socket: ClientConnection | None = self._open()
        self._thread = threading.Thread(target=self._run, name="rosbridge", daemon=True)
        self._thread.start()

    @property
    def connected(self) -> bool:
        """True while the connection is open."""
        return self._socket is not None

    def send(self, operation: Operation) -> None:
        """Send an operation.

        Raises:
            DeviceError: the connection is lost.
        """
        socket = self._socket
        if socket is None:
            raise self._lost()
        try:
            socket.send(json.dumps(operation, allow_nan=False))
        except (WebSocketException, OSError) as error:
            raise self._lost() from error

    def close(self) -> None:
        """End the connection."""
        self._ended.set()
        if (socket := self._socket) is not None:
            socket.close()
        self._thread.join(2.0 * _OPEN_S)
        if (socket := self._socket) is not None:  # opened again meanwhile
            socket.close()

    def _lost(self) -> DeviceError:
        return DeviceError("is not connected.", field=self._address, hint="check the network and rosbridge_server")

    def _open(self) -> ClientConnection:
        try:
            socket = connect(self._address, open_timeout=_OPEN_S, close_timeout=1.0, max_size=_MAX_MESSAGE)
        except InvalidURI as error:
            raise InputError("is no address.", field=self._address, hint="give ws://host:9090") from error
        except (WebSocketException, OSError) as error:
            hint = "start rosbridge_server on the robot, and check host and port"
            raise DeviceError(f"cannot be reached ({error}).", field=self._address, hint=hint) from error
        for operation in self._greet():
            socket.send(json.dumps(operation, allow_nan=False))
        return socket

    def _run(self) -> None:
        while not self._ended.is_set():
            if (socket := self._socket) is None:
                with suppress(DeviceError, WebSocketException, OSError):
                    self._socket = self._open()
                if self._socket is None:
                    self._ended.wait(_RETRY_S)
                continue
            with suppress(WebSocketException, OSError):
                for text in socket:
                    self._read(text)
            self._socket = None  # first: a thread that reads the count then finds no connection
            self.losses += 1

    def _read(self, text: str | bytes) -> None:
        try:
            operation = json.loads(text)
            if isinstance(operation, dict):
                self._take(operation)
        except Exception as error:  # no message of a client may end the thread
            _log.warning("%s sent a message that has no effect (%s)", self._address, error)

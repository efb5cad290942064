"""Server of the page: one thread, HTTP for the page and a WebSocket for each browser, on this machine alone."""

from __future__ import annotations

import asyncio
import json
import logging
import threading
import time
from contextlib import AbstractContextManager
from dataclasses import dataclass
from http import HTTPStatus
from importlib import resources
from types import TracebackType
from typing import Any, Literal
from urllib.parse import urlsplit

from websockets.asyncio.server import ServerConnection, serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request, Response

from splatbot.errors import InputError
from splatbot.results.metrics import without_nan
from splatbot.services.access import Access
from splatbot.services.connections import Connections, listen
from splatbot.services.live_training.requests import MAX_BYTES, LiveRequest, parse_request
from splatbot.services.settings import load_settings
from splatbot.services.viewer.door import Door

HOST = "127.0.0.1"
DEFAULT_PORT = 8081


@dataclass(frozen=True)
class LivePageConstants:
    """Constants of the server.

    Args:
        clients: browsers at once.
        connections: connections at once; the oldest that is no WebSocket makes room.
        request_s: [s] least time between two requests of a browser.
        opening_s: [s] time within which a connection sends its request.
        unread_s: [s] time without progress after which a connection whose client does not read ends.
        ending_s: [s] time for the last messages of a training.
    """

    clients: int = 4
    connections: int = 32
    request_s: float = 0.02
    opening_s: float = 10.0
    unread_s: float = 30.0
    ending_s: float = 1.0


CONSTANTS = LivePageConstants()

Kind = Literal["scene", "status", "photo", "picture", "problem"]
_KINDS: tuple[Kind, ...] = ("scene", "status", "photo", "picture", "problem")

_HEADERS = {
    "Content-Type": "text/html; charset=utf-8",
    "Cache-Control": "no-store",
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'unsafe-inline'; style-src 'unsafe-inline'; img-src data:; "
        "connect-src 'self'; base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "Referrer-Policy": "no-referrer",
    "X-Content-Type-Options": "nosniff",
}

# Scans of ports and damaged requests are no errors of this program.
_log = logging.getLogger(f"{__name__}.websockets")
_log.addFilter(lambda record: "handshake" not in record.getMessage())


class LiveClient:
    """One browser: the view that it wants, and the latest message of each kind that it has not got yet.

    Attributes:
        request: the latest; None before the first.
        shown: request of the last picture. This and the next attributes belong to the thread that trains.
        shown_s: time of the last picture [s].
        shown_iteration: iteration of the last picture.
        photographed: view and width of the last photograph.
        status_s: time of the last status [s].
    """

    def __init__(self, loop: asyncio.AbstractEventLoop) -> None:
        self.request: LiveRequest | None = None
        self.shown: LiveRequest | None = None
        self.shown_s = self.status_s = float("-inf")
        self.shown_iteration = -1
        self.photographed: tuple[int, int] | None = None
        self._loop, self._news = loop, asyncio.Event()
        self._waiting: dict[Kind, str] = {}

    @property
    def waits(self) -> bool:
        """Return whether a message has not been sent yet."""
        return bool(self._waiting)

    @property
    def waits_for_image(self) -> bool:
        """Return whether an image has not been sent yet."""
        return "photo" in self._waiting or "picture" in self._waiting

    def put(self, kind: Kind, message: str) -> None:
        """Send a message soon, in place of one of its kind that waits; call from any thread."""
        self._waiting[kind] = message
        self._loop.call_soon_threadsafe(self._news.set)

    async def next(self) -> list[str]:
        """Wait for messages, and take them."""
        await self._news.wait()
        self._news.clear()
        return [self._waiting.pop(kind) for kind in _KINDS if kind in self._waiting]


class LivePage(AbstractContextManager["LivePage"]):
    """Serves the page at http://127.0.0.1:PORT while the block runs; nothing can be changed through it.

    A browser needs the key of the service, as for ``splatbot view``. Names and origins are checked.

    Args:
        port: to listen on; 0 takes a free one.

    Attributes:
        clients: the browsers that are connected.
        busy_s: processor time of the server's thread [s].

    Raises:
        InputError: the port is taken.
        ConfigError: a setting of the service is wrong, or its key cannot be made.
    """

    def __init__(self, port: int) -> None:
        self.access = Access(load_settings(host=HOST))
        self.clients: tuple[LiveClient, ...] = ()
        self.busy_s = 0.0
        self._connections = Connections(
            CONSTANTS.connections, CONSTANTS.connections, CONSTANTS.opening_s, CONSTANTS.unread_s
        )
        self._door = Door(self.access, CONSTANTS.clients)
        self._body = page_html().encode()
        self._views = 0
        self._greetings: dict[Kind, str] = {}
        try:
            self._listener = listen(HOST, port, self._connections)
        except InputError as error:
            error.field, error.hint = "--viewer", "name another port, or 0 for a free one"
            raise
        self.port = int(self._listener.getsockname()[1])
        self._opened = threading.Event()
        self._thread = threading.Thread(target=self._run, name="live-training", daemon=True)

    def __enter__(self) -> LivePage:
        self._thread.start()
        self._opened.wait()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._loop.call_soon_threadsafe(self._ended.set)
        self._thread.join()

    def show(self, scene: dict[str, Any], views: int) -> None:
        """Announce the scene, and take requests for its views."""
        self._views = views
        self.announce("scene", message("scene", scene))

    def announce(self, kind: Kind, text: str) -> None:
        """Send a message to all browsers, also to those that come later."""
        self._greetings[kind] = text
        for client in self.clients:
            client.put(kind, text)

    def _run(self) -> None:
        try:
            asyncio.run(self._serve())
        finally:
            self.clients = ()
            self._opened.set()

    async def _serve(self) -> None:
        self._loop, self._ended = asyncio.get_running_loop(), asyncio.Event()
        async with serve(
            self._attend,
            sock=self._listener,
            process_request=self._answer,
            server_header=None,
            compression=None,
            max_size=MAX_BYTES,
            max_queue=4,
            open_timeout=CONSTANTS.opening_s,
            close_timeout=CONSTANTS.ending_s,
            logger=_log,
        ) as server:
            self._opened.set()
            await self._ended.wait()
            until = time.monotonic() + CONSTANTS.ending_s
            while any(client.waits for client in self.clients) and time.monotonic() < until:
                await asyncio.sleep(0.02)
            for connection in server.connections:
                if connection.transport.get_write_buffer_size():  # its client does not read, and closing would wait
                    connection.transport.abort()

    def _answer(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return a refusal, the page, or None for a WebSocket."""
        refusal = self._door(connection, request)
        if refusal is not None:
            return refusal
        path = urlsplit(request.path).path
        if path == "/live":
            self._connections.mark(connection.transport.get_extra_info("socket").fileno(), busy=True)
            return None
        if path != "/":
            return connection.respond(HTTPStatus.NOT_FOUND, "The page is at /.\n")
        headers = Headers({**_HEADERS, "Content-Length": str(len(self._body)), "Connection": "close"})
        return Response(HTTPStatus.OK, HTTPStatus.OK.phrase, headers, self._body)

    async def _attend(self, connection: ServerConnection) -> None:
        """Serve one browser."""
        client = LiveClient(self._loop)
        self.clients = (*self.clients, client)
        for kind, greeting in list(self._greetings.items()):
            client.put(kind, greeting)
        sender = asyncio.create_task(self._deliver(client, connection))
        try:
            async for text in connection:
                client.request = parse_request(text, self._views)
                self.busy_s = time.thread_time()
                await asyncio.sleep(CONSTANTS.request_s)
        except InputError as error:
            await connection.close(1008, str(error)[:120])
        except ConnectionClosed:
            pass
        finally:
            self.clients = tuple(other for other in self.clients if other is not client)
            sender.cancel()

    async def _deliver(self, client: LiveClient, connection: ServerConnection) -> None:
        try:
            while True:
                for text in await client.next():
                    await connection.send(text)
                self.busy_s = time.thread_time()
        except ConnectionClosed:
            pass


def message(kind: Kind, values: dict[str, Any]) -> str:
    """Return a message of the server as JSON; a number that is not finite is null."""
    return json.dumps(without_nan({"kind": kind, **values}), allow_nan=False)


def page_html() -> str:
    """Return the page with its script and styles; it fetches nothing else."""
    own = resources.files("splatbot.services.live_training")
    parts = {
        "STYLE": resources.files("splatbot.report").joinpath("style.css").read_text(encoding="utf-8"),
        "OWN_STYLE": own.joinpath("page.css").read_text(encoding="utf-8"),
        "SCRIPT": own.joinpath("page.js").read_text(encoding="utf-8"),
    }
    page = own.joinpath("page.html").read_text(encoding="utf-8")
    for name, text in parts.items():
        page = page.replace(f"/*{name}*/", text)
    return page

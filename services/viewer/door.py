"""Access control of the viewer, which viser lacks: names, origins and the key of each connection."""

from __future__ import annotations

import secrets
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from http import HTTPStatus
from http.cookies import CookieError, SimpleCookie
from typing import Any
from urllib.parse import parse_qs, urlsplit

import websockets.asyncio.server
from websockets.asyncio.server import ServerConnection
from websockets.http11 import Request, Response

from splatbot.errors import NativeError
from splatbot.service_key import key_file
from splatbot.services.access import Access

Check = Callable[[ServerConnection, Request], Response | None]

_PAGE = '<!doctype html><meta name="referrer" content="no-referrer"><meta http-equiv="refresh" content="0;url=/">'
_ASK = """<!doctype html><html lang="en"><meta charset="utf-8"><meta name="referrer" content="no-referrer">
<meta name="viewport" content="width=device-width, initial-scale=1"><title>splatbot viewer</title>
<style>:root { color-scheme: light dark } body { font: 16px/1.5 system-ui, sans-serif; max-width: 30rem;
margin: 20vh auto; padding: 0 1rem } input, button { font: inherit; padding: .4rem .6rem; width: 100%;
box-sizing: border-box; margin: .3rem 0 }</style>
<h1>splatbot viewer</h1><p>The map is shown to clients with the key of the service. It is in the file that the service
names at its start, by default <code>~/.local/state/splatbot/service-key</code>.</p>
<form method="get" action="/"><label>Key
<input type="password" name="key" autocomplete="off" autofocus required></label>
<button>Open the viewer</button></form><p>The address <code>/?key=KEY</code> opens it at once.</p>NOTE"""
_opening = threading.Lock()


def no_connection(connection: ServerConnection, _request: Request) -> Response:
    """Refuse a connection: the server only draws."""
    return connection.respond(HTTPStatus.FORBIDDEN, "This server takes no connections.\n")


class Door:
    """Check of connections to the viewer.

    A browser shows the key once (``/?key=KEY``) and gets a cookie, which other sites cannot use. The cookie is no key:
    it opens this viewer, until the viewer ends.

    Args:
        access: names, origins and keys of the service.
        most: viewers at once.
    """

    def __init__(self, access: Access, most: int = 32) -> None:
        self._access = access
        self._most = most
        self._ticket = secrets.token_urlsafe(32)

    def __call__(self, connection: ServerConnection, request: Request) -> Response | None:
        """Return a refusal, the form for the key, the answer to a key, or None to let the connection pass."""
        hosts, origins = request.headers.get_all("Host"), request.headers.get_all("Origin")
        if len(hosts) != 1 or not self._access.host_allowed(hosts[0]):
            return connection.respond(HTTPStatus.MISDIRECTED_REQUEST, "This is no name of the viewer: use localhost.\n")
        if len(origins) > 1 or (origins and not self._access.origin_allowed(origins[0], "http", hosts[0])):
            return connection.respond(HTTPStatus.FORBIDDEN, "Pages of other sites may not connect.\n")
        if len(connection.server.connections) >= self._most:
            return connection.respond(HTTPStatus.SERVICE_UNAVAILABLE, f"{self._most} viewers are open: close one.\n")
        cookie = f"splatbot_viewer_{connection.local_address[1]}"  # cookies of all ports of a host are shared
        if self._access.is_open or self._has_ticket(request, cookie):
            return None
        key = parse_qs(urlsplit(request.path).query).get("key", [""])[0]
        if not self._access.holds_key(key):
            note = '<p role="alert">This key is not the one of the service.</p>' if key else ""
            return _html(connection.respond(HTTPStatus.UNAUTHORIZED, _ASK.replace("NOTE", note)))
        response = _html(connection.respond(HTTPStatus.OK, _PAGE))
        response.headers["Set-Cookie"] = f"{cookie}={self._ticket}; Path=/; HttpOnly; SameSite=Strict"
        return response

    def _has_ticket(self, request: Request, name: str) -> bool:
        for header in request.headers.get_all("Cookie"):
            try:
                found = SimpleCookie(header).get(name)
            except CookieError:
                continue
            if found is not None and secrets.compare_digest(found.value.encode(), self._ticket.encode()):
                return True
        return False


def _html(response: Response) -> Response:
    """Return the response as a page that no browser keeps."""
    del response.headers["Content-Type"]
    response.headers["Content-Type"] = "text/html; charset=utf-8"
    response.headers["Cache-Control"] = "no-store"
    return response


def opening_address(access: Access, host: str, port: int, *, to_terminal: bool) -> str:
    """Return the address that opens a viewer; its key is shown to a terminal only, and its file is named elsewhere."""
    key = access.shown_key(to_terminal=to_terminal)
    where = f" (KEY is in {key_file()})" if key is None and access.uses_key_file else ""
    return f"http://{host}:{port}/?key={key or 'KEY'}{where}"


@contextmanager
def guarded(check: Check) -> Iterator[None]:
    """Let the server that viser opens in the block check each connection first.

    Viser has no hook for this, so that the function with which it opens its server is replaced for the block.

    Raises:
        NativeError: viser has opened its server in another way.
    """
    module, checks = websockets.asyncio.server, list[Check]()
    original = module.serve

    def serve(*args: Any, process_request: Check, **more: Any) -> Any:
        def ask(connection: ServerConnection, request: Request) -> Response | None:
            return check(connection, request) or process_request(connection, request)

        checks.append(check)
        return original(*args, process_request=ask, **more)

    with _opening:
        module.serve = serve  # type: ignore[assignment, misc]
        try:
            yield
        finally:
            module.serve = original  # type: ignore[misc]
    if not checks:
        raise NativeError("cannot be guarded.", field="viser", hint="install viser 1.1")

"""Browsers of a training's page: the real HTTP and WebSocket clients of other libraries."""

from __future__ import annotations

import http.client
import json
from contextlib import suppress
from typing import Any

import websockets.sync.client
from websockets.sync.client import ClientConnection
from websockets.sync.connection import Connection

from splatbot.service_key import key_file, read_key
from splatbot.services.live_training.server import LivePage


def get(page: LivePage, path: str, *, method: str = "GET", **headers: str) -> tuple[int, dict[str, str], str]:
    """Return status, headers and body of one HTTP request."""
    connection = http.client.HTTPConnection("127.0.0.1", page.port, timeout=10)
    try:
        connection.request(method, path, headers=headers)
        answer = connection.getresponse()
        return answer.status, dict(answer.getheaders()), answer.read().decode()
    finally:
        connection.close()


def cookie_of(page: LivePage) -> str:
    """Return the cookie that the key buys."""
    _, headers, _ = get(page, f"/?key={read_key(key_file())}")
    return headers["Set-Cookie"].partition(";")[0]


def connect(page: LivePage, **headers: str) -> ClientConnection:
    """Open a WebSocket as the page does."""
    given = headers if "Cookie" in headers else {"Cookie": cookie_of(page), **headers}
    return websockets.sync.client.connect(
        f"ws://127.0.0.1:{page.port}/live", additional_headers=given, proxy=None, open_timeout=10
    )


def receive(browser: Connection, kind: str) -> dict[str, Any]:
    """Return the next message of a kind, and drop those before."""
    while True:
        found: dict[str, Any] = json.loads(browser.recv(timeout=60))
        if found["kind"] == kind:
            return found


def read_all(browser: Connection) -> None:
    """Read the messages that have arrived, as a browser does at once."""
    with suppress(TimeoutError):
        while True:
            browser.recv(timeout=0)


def want(browser: Connection, view: int, width: int, pose: list[float] | None = None) -> None:
    """Request a view."""
    browser.send(json.dumps({"view": view, "width": width, "pose": pose}))

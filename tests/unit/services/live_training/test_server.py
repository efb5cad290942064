"""The page's server against real clients: access, bounds of requests, the end."""

from __future__ import annotations

import json
import re
import socket
import threading
import time
from collections.abc import Iterator

import pytest
from websockets.exceptions import ConnectionClosed, InvalidStatus

from splatbot.errors import InputError
from splatbot.services.live_training.server import CONSTANTS, LivePage
from tests.unit.services.live_training.browsers import connect, cookie_of, get, receive, want
from tests.waiting import until


@pytest.fixture
def page() -> Iterator[LivePage]:
    with LivePage(0) as opened:
        opened.show({"name": "ball", "trained": 2, "views": [], "up": [0, 0, 1]}, 3)
        yield opened


def test_the_page_holds_all_that_it_needs(page: LivePage) -> None:
    status, headers, body = get(page, "/", Cookie=cookie_of(page))
    assert status == 200
    assert headers["Content-Type"] == "text/html; charset=utf-8"
    assert "default-src 'none'" in headers["Content-Security-Policy"]
    assert not re.search(r"/\*[A-Z_]+\*/", body)  # each part is in its place
    assert not re.search(r"(?:src|href|url)\s*[=(]\s*[\"']?(?:https?:)?//", body)


def test_without_the_key_there_is_a_form_and_no_socket(page: LivePage) -> None:
    for path in ("/", "/live", "/?key=wrong"):
        status, _, body = get(page, path)
        assert status == 401
        assert "training" not in body.lower()
    with pytest.raises(InvalidStatus) as refused:
        connect(page, Cookie="splatbot_viewer=guess")
    assert refused.value.response.status_code == 401
    assert page.clients == ()


@pytest.mark.parametrize("host", ["evil.example", "127.0.0.1.evil.example", "192.0.2.7", ""])
def test_another_name_than_that_of_this_machine_is_refused(page: LivePage, host: str) -> None:
    assert get(page, "/", Host=host, Cookie=cookie_of(page))[0] == 421


@pytest.mark.parametrize("origin", ["http://evil.example", "null", "http://127.0.0.1:1"])
def test_pages_of_other_origins_open_no_socket(page: LivePage, origin: str) -> None:
    with pytest.raises(InvalidStatus) as refused:
        connect(page, Origin=origin)
    assert refused.value.response.status_code == 403


def test_the_own_origin_opens_a_socket_and_gets_the_scene(page: LivePage) -> None:
    with connect(page, Origin=f"http://127.0.0.1:{page.port}") as browser:
        assert receive(browser, "scene")["name"] == "ball"


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "PATCH"])
def test_no_method_but_get_is_served(page: LivePage, method: str) -> None:
    with socket.create_connection(("127.0.0.1", page.port), timeout=10) as line:
        line.sendall(f"{method} / HTTP/1.1\r\nHost: 127.0.0.1\r\nCookie: {cookie_of(page)}\r\n\r\n".encode())
        assert b"200 OK" not in line.recv(1000)
    assert get(page, "/nothing", Cookie=cookie_of(page))[0] == 404


@pytest.mark.parametrize(
    "text",
    [
        "no json",
        "[1]",
        "null",
        b"\xff\xfe",
        "[" * 4000,
        json.dumps({"view": 0, "width": 64}),
        json.dumps({"view": 3, "width": 64, "pose": None}),
        json.dumps({"view": -1, "width": 64, "pose": None}),
        json.dumps({"view": True, "width": 64, "pose": None}),
        json.dumps({"view": 0, "width": 0, "pose": None}),
        json.dumps({"view": 0, "width": 1e9, "pose": None}),
        json.dumps({"view": 0, "width": 64, "pose": None, "write": 1}),
        json.dumps({"view": 0, "width": 64, "pose": [0.0] * 16}),
        json.dumps({"view": 0, "width": 64, "pose": [1, 0, 0, 1e300, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}),
        json.dumps({"view": 0, "width": 64, "pose": [1, 0, 0, 10**400, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}),
        json.dumps({"view": 0, "width": 64, "pose": [float("nan")] * 16}),
        json.dumps({"view": 0, "width": 64, "pose": [-1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]}),
        json.dumps({"view": 0, "width": 64, "pose": ["1"] * 16}),
    ],
)
def test_a_wrong_request_ends_its_connection_and_no_other(page: LivePage, text: str | bytes) -> None:
    with connect(page) as other, connect(page) as browser:
        browser.send(text)
        with pytest.raises(ConnectionClosed) as closed:
            receive(browser, "status")
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1008
        want(other, 2, 64)
        until(lambda: any(client.request is not None for client in page.clients), 10)
    until(lambda: page.clients == (), 10)


def test_a_request_beyond_the_bound_ends_its_connection(page: LivePage) -> None:
    with connect(page) as browser:
        browser.send(" " * 5000)
        with pytest.raises(ConnectionClosed) as closed:
            receive(browser, "status")
        assert closed.value.rcvd is not None
        assert closed.value.rcvd.code == 1009


def test_the_rigid_pose_of_a_request_arrives_as_it_was_sent(page: LivePage) -> None:
    pose = [0.0, -1.0, 0.0, 1.5, 1.0, 0.0, 0.0, -2.0, 0.0, 0.0, 1.0, 0.25, 0.0, 0.0, 0.0, 1.0]
    with connect(page) as browser:
        want(browser, 1, 640, pose)
        until(lambda: page.clients and page.clients[0].request is not None, 10)
        request = page.clients[0].request
    assert request is not None
    assert (request.view, request.width) == (1, 640)
    assert request.pose is not None
    assert request.pose.ravel().tolist() == pytest.approx(pose, abs=1e-12)


def test_one_browser_too_many_is_refused_until_another_leaves(page: LivePage) -> None:
    browsers = [connect(page) for _ in range(CONSTANTS.clients)]
    try:
        cookie = browsers[0].request.headers["Cookie"]  # type: ignore[union-attr]
        with pytest.raises(InvalidStatus) as refused:
            connect(page, Cookie=cookie)
        assert refused.value.response.status_code == 503
        browsers.pop().close()
        until(lambda: len(page.clients) < CONSTANTS.clients, 10)
        browsers.append(connect(page, Cookie=cookie))
    finally:
        for browser in browsers:
            browser.close()


def test_many_silent_connections_leave_the_browser_its_own(page: LivePage) -> None:
    with connect(page) as browser:
        receive(browser, "scene")
        lines = [socket.create_connection(("127.0.0.1", page.port)) for _ in range(2 * CONSTANTS.connections)]
        try:
            until(lambda: len(page._connections) <= CONSTANTS.connections, 10)
            page.clients[0].put("status", '{"kind": "status"}')
            assert receive(browser, "status") == {"kind": "status"}
        finally:
            for line in lines:
                line.close()


def test_only_the_latest_of_the_messages_that_wait_is_sent(page: LivePage) -> None:
    with connect(page) as browser:
        receive(browser, "scene")
        client = page.clients[0]

        def put_all() -> None:
            for n in range(50):
                client.put("picture", json.dumps({"kind": "picture", "n": n}))

        page._loop.call_soon_threadsafe(put_all)
        assert receive(browser, "picture")["n"] == 49
        assert not client.waits


def test_a_taken_port_is_named_with_the_option_before_anything_begins(page: LivePage) -> None:
    before = threading.active_count()
    with pytest.raises(InputError, match=rf"--viewer: cannot listen on 127\.0\.0\.1 port {page.port}.*another port"):
        LivePage(page.port)
    assert threading.active_count() == before


def test_the_end_sends_what_waits_and_closes_all() -> None:
    with LivePage(0) as page:
        browser = connect(page)
        until(lambda: page.clients, 10)
        page.clients[0].put("status", '{"kind": "status", "ended": true}')
    assert receive(browser, "status")["ended"] is True
    with pytest.raises(ConnectionClosed):
        browser.recv(timeout=10)
    with pytest.raises(OSError, match="refused"):
        socket.create_connection(("127.0.0.1", page.port))


def test_a_browser_that_does_not_read_does_not_hold_up_the_end() -> None:
    upgrade = "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\nSec-WebSocket-Key: "
    with socket.socket() as line:
        with LivePage(0) as page:
            page.show({"name": "x" * 3_000_000, "trained": 2, "views": [], "up": [0, 0, 1]}, 3)
            line.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            line.connect(("127.0.0.1", page.port))
            line.sendall(
                f"GET /live HTTP/1.1\r\nHost: 127.0.0.1:{page.port}\r\nCookie: {cookie_of(page)}\r\n"
                f"{upgrade}AAAAAAAAAAAAAAAAAAAAAA==\r\n\r\n".encode()
            )
            until(lambda: bool(page.clients))
            for _ in range(3):
                page.announce("status", "y" * 1_000_000)
            began = time.monotonic()
        assert time.monotonic() - began < 8.0  # the keepalive of WebSockets alone takes up to 40 s

"""Requests without the right: pages of other sites, rebound names, strangers, keys without the scope."""

from __future__ import annotations

import asyncio
import json
import logging
import os
import re
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any

import httpx
import pytest
import viser
from fastapi.routing import APIRoute
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.sync.connection import Connection
from websockets.typing import Origin, Subprotocol

from splatbot.client import Client, ServiceError
from splatbot.errors import ConfigError
from splatbot.robots.panda import panda
from splatbot.service_key import key_file, make_key, read_key
from splatbot.services.access import Access
from splatbot.services.app import create_app
from splatbot.services.keys import hash_key, known_key, new_key, scopes_of
from splatbot.services.requests import JsonFormatter, TextFormatter
from splatbot.services.ros.follow import action_topic
from splatbot.services.runtime import Runtime, check_exposure
from splatbot.services.scopes import NEEDS
from splatbot.services.settings import ServiceSettings, load_settings
from splatbot.services.viewer.scene import close_server, open_server
from splatbot.services.viewer.viewer import Viewer
from tests.contracts.conftest import Service, running, wall, wall_store

EVIL = "https://evil.example"
READ, MAP, MOVE, USUAL = (new_key() for _ in range(4))
JSON = {"Content-Type": "application/json"}


@pytest.fixture(scope="module")
def home() -> Iterator[Service]:
    """A service on loopback without configured keys."""
    with running(
        ServiceSettings(cors_origins=("https://ui.example",), allowed_hosts=("robot.lan",)), wall_store()
    ) as it:
        yield it


@pytest.fixture(scope="module")
def keyed() -> Iterator[Service]:
    """A service with a key for each of some scopes."""
    entries = (hash_key(READ, ("read",)), hash_key(MAP, ("read", "map")), hash_key(MOVE, ("read", "move")))
    with running(ServiceSettings(api_keys=(*entries, hash_key(USUAL))), wall_store()) as it:
        yield it


def _stranger(service: Service) -> httpx.Client:
    return httpx.Client(base_url=service.url, timeout=20)


def _raw(service: Service, request: str) -> tuple[int, bytes]:
    """Send bytes as they are and return the status and all that comes until the service closes the line."""
    with socket.create_connection(("127.0.0.1", service.client.base_url.port or 0), timeout=5) as line:
        line.sendall(request.encode("latin-1"))
        data = b""
        while chunk := line.recv(65536):
            data += chunk
    return int(data.split(b" ", 2)[1]), data


# ------------------------------------------------------------------ names and origins


@pytest.mark.parametrize("name", ["evil.example", "evil.example:8000", "localhost.evil.example", "0.0.0.0", "10.0.0.7"])
@pytest.mark.parametrize(("method", "path"), [("GET", "/v1/maps"), ("DELETE", "/v1/maps/wall"), ("GET", "/healthz")])
def test_a_rebound_name_is_refused_before_anything_else(home: Service, name: str, method: str, path: str) -> None:
    answer = home.client.request(method, path, headers={"Host": name})
    assert answer.status_code == 421
    assert "SPLATBOT_ALLOWED_HOSTS" in answer.json()["hint"]
    assert home.store.get("wall").map_version == 1


def test_names_of_this_machine_and_allowed_ones_are_served(home: Service) -> None:
    for name in ("localhost", "LOCALHOST:1", "localhost.", "127.0.0.1:8000", "127.8.8.8", "[::1]:8000", "robot.lan:80"):
        assert home.client.get("/v1/maps", headers={"Host": name}).status_code == 200, name
    for wrong in ("", "a b", "[::1", "user@localhost", "localhost:x", "127.0.0.1.evil.example"):
        assert _raw(home, f"GET /v1/maps HTTP/1.1\r\nHost: {wrong}\r\nConnection: close\r\n\r\n")[0] in (400, 421), (
            wrong
        )


def test_a_service_that_others_reach_takes_addresses_and_names_that_are_listed() -> None:
    settings = ServiceSettings(host="0.0.0.0", api_keys=(hash_key(USUAL),), allowed_hosts=("robot.lan",))
    app = create_app(Runtime(settings, wall_store()))

    async def ask(name: str) -> int:
        transport = httpx.ASGITransport(app)
        async with httpx.AsyncClient(transport=transport, base_url=f"http://{name}") as client:
            return (await client.get("/v1/maps", headers={"X-API-Key": USUAL})).status_code

    names = ("192.168.1.5:8000", "robot.lan", "localhost", "[fe80::1]", "evil.example")
    assert [asyncio.run(ask(name)) for name in names] == [200, 200, 200, 200, 421]


@pytest.mark.parametrize("origin", [EVIL, "null", "http://127.0.0.1:1", "https://ui.example.evil.example"])
@pytest.mark.parametrize("path", ["/v1/stop", "/v1/maps/wall/distance", "/v1/maps/wall/render", "/v1/maps"])
def test_a_page_of_another_site_may_post_nothing_even_with_the_key(home: Service, origin: str, path: str) -> None:
    answer = home.client.post(path, json={"points": []}, headers={"Origin": origin})
    assert answer.status_code == 403
    assert "SPLATBOT_CORS_ORIGINS" in answer.json()["hint"]
    assert home.client.delete("/v1/maps/wall", headers={"Origin": origin}).status_code == 403
    assert home.client.get("/v1/stop").json()["stopped"] is False


@pytest.mark.parametrize("kind", ["text/plain", "application/x-www-form-urlencoded", "multipart/form-data", None])
def test_a_blob_that_a_page_sends_without_asking_first_is_no_body(home: Service, kind: str | None) -> None:
    headers = {"Content-Type": kind} if kind else {}
    for path in ("/v1/maps", "/v1/maps/wall/distance", "/v1/maps/wall/render", "/v1/stop", "/v1/ik"):
        answer = home.client.post(path, content=b'{"id": "a"}', headers=headers)
        assert answer.status_code == 415, path
        assert answer.headers["content-type"] == "application/problem+json"
    assert [m["id"] for m in home.client.get("/v1/maps").json()["maps"]] == ["wall"]
    assert home.client.get("/v1/stop").json()["stopped"] is False


def test_a_body_of_a_kind_that_the_route_does_not_take_is_415(home: Service) -> None:
    for path in ("/v1/maps", "/v1/maps/wall/render"):
        answer = home.client.post(path, content=b"PK", headers={"Content-Type": "application/zip"})
        assert answer.status_code == 415
    assert home.client.post("/v1/maps").status_code == 415


def test_pages_of_the_service_and_of_named_origins_may_ask(home: Service) -> None:
    for origin in (home.url, "https://ui.example"):
        answer = home.client.post("/v1/maps/wall/distance", json={"points": []}, headers={"Origin": origin})
        assert answer.status_code == 200, origin
    asked = {"Origin": EVIL, "Access-Control-Request-Method": "DELETE"}
    assert home.client.options("/v1/maps/wall", headers=asked).status_code in (400, 403)


@pytest.mark.parametrize("path", ["/rosbridge", "/foxglove", "/"])
def test_a_page_of_another_site_or_of_a_rebound_name_opens_no_websocket(home: Service, path: str) -> None:
    protocols = [Subprotocol("foxglove.sdk.v1")] if path == "/foxglove" else None
    for origin in (EVIL, "null", "http://localhost:1"):
        with pytest.raises(InvalidStatus) as caught, connect(home.ws(path), origin=Origin(origin)):
            pass
        assert caught.value.response.status_code == 403
        assert b"SPLATBOT_CORS_ORIGINS" in caught.value.response.body
    lines = (
        "Upgrade: websocket\r\nConnection: Upgrade\r\nSec-WebSocket-Version: 13\r\n"
        "Sec-WebSocket-Key: AAAAAAAAAAAAAAAAAAAAAA==\r\n"
    )
    status, _ = _raw(home, f"GET {path} HTTP/1.1\r\nHost: evil.example\r\n{lines}\r\n")
    assert status in (403, 421)
    for known in (home.url, "https://ui.example", None):
        with connect(home.ws(path), origin=Origin(known) if known else None, subprotocols=protocols) as it:
            assert it.protocol.state.name == "OPEN"


# ------------------------------------------------------------------ keys and scopes


def test_every_route_has_its_scope() -> None:
    app = create_app(Runtime(ServiceSettings(), wall_store()))
    document = app.openapi()
    routes = {(m.upper(), path) for path, item in document["paths"].items() for m in item}
    assert {(m, path) for m, path in routes if m not in ("GET", "HEAD")} == set(NEEDS)
    hidden = [r for r in app.routes if isinstance(r, APIRoute) and not r.include_in_schema]
    assert hidden == []


def test_a_route_that_nobody_listed_is_an_administrators(keyed: Service) -> None:
    keyed.app.add_api_route("/v1/new", lambda: {}, methods=["POST"])
    answer = keyed.client.post("/v1/new", headers={"X-API-Key": USUAL})
    assert (answer.status_code, "admin" in answer.json()["detail"]) == (403, True)


@pytest.mark.parametrize(("method", "path"), sorted(NEEDS))
def test_on_loopback_whatever_changes_needs_a_key(home: Service, method: str, path: str) -> None:
    url = re.sub(r"\{.*?\}", "wall", path)
    with _stranger(home) as stranger:
        answer = stranger.request(method, url, headers=JSON)
        wrong = stranger.request(method, url, headers=JSON | {"Authorization": "Bearer spb_guess"})
    assert wrong.status_code == 401
    if NEEDS[method, path] == "read":
        assert answer.status_code != 401
        home.client.delete("/v1/stop")
    else:
        assert answer.status_code == 401
        assert NEEDS[method, path] in answer.json()["detail"]
    assert home.store.get("wall").map_version == 1


@pytest.mark.parametrize("key", [READ, MAP, MOVE, USUAL], ids=["read", "map", "move", "usual"])
@pytest.mark.parametrize(("method", "path"), sorted(NEEDS))
def test_a_key_opens_what_its_scopes_say(keyed: Service, key: str, method: str, path: str) -> None:
    scopes = {READ: {"read"}, MAP: {"read", "map"}, MOVE: {"read", "move"}, USUAL: {"read", "map", "move"}}[key]
    url = re.sub(r"\{.*?\}", "nothing", path)
    answer = keyed.client.request(method, url, headers=JSON | {"X-API-Key": key})
    assert (answer.status_code == 403) == (NEEDS[method, path] not in scopes), answer.text
    if answer.status_code == 403:
        assert NEEDS[method, path] in answer.json()["detail"]
        assert "--new-key --scopes" in answer.json()["hint"]
    keyed.client.delete("/v1/stop", headers={"X-API-Key": MOVE})


def test_strangers_are_refused_before_their_body_is_read(home: Service) -> None:
    head = "Host: localhost\r\nContent-Type: application/msgpack\r\nContent-Length: 10000000\r\n\r\n"
    for path in ("/v1/maps", "/v1/maps/wall/frames", "/v1/trajectories"):
        status, _ = _raw(home, f"POST {path} HTTP/1.1\r\n{head}")
        assert status == 401


def test_names_and_origins_that_never_match_are_refused_as_settings() -> None:
    for field, words in {
        "allowed_hosts": ("http://robot.lan", "robot.lan:8000", "*"),
        "cors_origins": ("https://ui.example/", "ui.example", "https://ui.example/page"),
    }.items():
        for word in words:
            with pytest.raises(ConfigError, match="never matches"):
                load_settings(None, **{field: (word,)})
    load_settings(allowed_hosts=("robot.lan", "fe80::1"), cors_origins=("*", "null", "app://x", "http://a:1"))


def test_a_client_of_the_same_user_finds_the_key(home: Service, monkeypatch: pytest.MonkeyPatch) -> None:
    with Client(home.url) as client:
        client.emergency_stop()
        assert client.reset_stop()["stopped"] is False
    monkeypatch.setenv("SPLATBOT_API_KEY", "spb_of_another_service")
    with Client(home.url) as client, pytest.raises(ServiceError, match="valid API key") as caught:
        client.maps()
    assert caught.value.status == 401
    monkeypatch.delenv("SPLATBOT_API_KEY")
    key_file().chmod(0o644)
    try:
        with pytest.raises(ConfigError, match="open to other users"):
            Client(home.url)
        with pytest.raises(ConfigError, match="open to other users"):
            create_app(Runtime(ServiceSettings()))
        Client("http://192.168.1.5:8000").close()  # of another machine: the file is not looked at
    finally:
        key_file().chmod(0o600)


def test_the_file_of_the_key_is_private_and_made_once(tmp_path: Path) -> None:
    path = tmp_path / "a" / "b" / "service-key"
    previous = os.umask(0)
    try:
        assert make_key(path, "spb_1") == "spb_1"
    finally:
        os.umask(previous)
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert stat.S_IMODE(path.parent.stat().st_mode) == 0o700
    assert make_key(path, "spb_2") == "spb_1"
    assert [p.name for p in path.parent.iterdir()] == ["service-key"]
    path.write_text("")
    with pytest.raises(ConfigError, match="no key"):
        read_key(path)
    assert read_key(tmp_path / "none") is None


def test_insecure_no_auth_opens_loopback_alone_and_still_refuses_pages() -> None:
    settings = ServiceSettings(insecure_no_auth=True)
    check_exposure(settings)
    with running(settings, wall_store()) as service, _stranger(service) as stranger:
        assert stranger.delete("/v1/maps/wall", headers={"Origin": EVIL}).status_code == 403
        assert stranger.delete("/v1/maps/wall", headers={"Host": "evil.example"}).status_code == 421
        assert stranger.delete("/v1/maps/wall").status_code == 204
    for wrong in (
        ServiceSettings(insecure_no_auth=True, host="0.0.0.0"),
        ServiceSettings(insecure_no_auth=True, api_keys=(hash_key(USUAL),)),
    ):
        with pytest.raises(ConfigError, match="insecure_no_auth"):
            check_exposure(wrong)


def test_scopes_of_keys_are_checked_by_name() -> None:
    assert scopes_of(hash_key(USUAL)) == {"read", "map", "move"}
    assert scopes_of(hash_key(USUAL, ("move",))) == {"read", "move"}
    assert known_key(USUAL, [hash_key(READ), hash_key(USUAL, ("read", "admin"))]) == hash_key(USUAL, ("read", "admin"))
    for wrong in (":write", ":", ":read+", ":READ", "x"):
        with pytest.raises(ValueError, match="api_keys"):
            ServiceSettings(api_keys=(hash_key(USUAL) + wrong,))


# ------------------------------------------------------------------ rosbridge


def _say(socket: Connection, **operation: Any) -> None:
    socket.send(json.dumps(operation))


def _told(socket: Connection) -> dict[str, Any]:
    return dict(json.loads(socket.recv(timeout=10)))


def test_rosbridge_without_a_key_reads_and_neither_moves_nor_maps(home: Service) -> None:
    goal = action_topic("fake", "goal")
    with connect(home.ws("/rosbridge").partition("?")[0]) as it:
        _say(it, op="call_service", id="a", service="/rosapi/topics")
        assert _told(it)["result"] is True
        _say(it, op="subscribe", topic="/odom")
        for scope, operation in (
            ("move", {"op": "publish", "topic": goal, "msg": {}}),
            ("move", {"op": "publish", "topic": goal[1:], "msg": {}}),
            ("move", {"op": "publish", "topic": action_topic("twin", "cancel"), "msg": {}}),
            ("map", {"op": "publish", "topic": "/camera/depth/image_raw", "msg": {}}),
            ("map", {"op": "advertise", "topic": "/a", "type": "std_msgs/String"}),
            ("map", {"op": "advertise_service", "service": "/a", "type": "a/b"}),
            ("map", {"op": "fragment", "id": "f", "num": 0, "total": 1, "data": '{"op": "advertise", "topic": "/b"}'}),
        ):
            _say(it, **operation)
            told = _told(it)
            assert (told["op"], told["level"]) == ("status", "error")
            assert f"scope '{scope}'" in told["msg"]
    assert "/a" not in home.app.state.ros.graph.topics
    assert home.client.get("/v1/arms/fake").json()["position"] == pytest.approx(list(panda().home))


def test_rosbridge_checks_the_scope_of_the_key(keyed: Service) -> None:
    url = keyed.ws("/rosbridge")
    with connect(f"{url}?api_key={MAP}") as mapper, connect(f"{url}?api_key={MOVE}") as mover:
        _say(mapper, op="advertise", topic="/mine", type="std_msgs/String")
        _say(mapper, op="advertise_service", service="/mine/reset", type="std_srvs/Empty")
        _say(mapper, op="publish", topic=action_topic("fake", "goal"), msg={})
        assert "'move'" in _told(mapper)["msg"]
        _say(mover, op="publish", topic="/mine", msg={"data": "x"})
        assert "'map'" in _told(mover)["msg"]
        _say(mover, op="call_service", id="c", service="/mine/reset")  # another client defines its effect
        told = _told(mover)
        assert told["result"] is False
        assert "'map'" in told["values"]
        goal = {"topic": action_topic("fake", "goal"), "type": "control_msgs/FollowJointTrajectoryActionGoal"}
        _say(mover, op="advertise", **goal)
        _say(mover, op="publish", **goal, msg={})
        _say(mover, op="call_service", id="d", service="/rosapi/nodes")
        assert _told(mover)["id"] == "d"


def test_foxglove_clients_only_read(keyed: Service) -> None:
    url = f"{keyed.ws('/foxglove')}?api_key={USUAL}"
    before = dict(keyed.app.state.ros.graph.topics)
    with connect(url, subprotocols=[Subprotocol("foxglove.sdk.v1")]) as it:
        assert _told(it)["capabilities"] == []
        for wrong in (
            {"op": "advertise", "channels": [{"id": 1, "topic": "/x", "encoding": "json", "schemaName": ""}]},
            {"op": "setParameters", "parameters": []},
            {"op": "advertiseServices", "services": []},
        ):
            it.send(json.dumps(wrong))
        it.send(b"\x01\x01\x00\x00\x00{}")  # client publish
        told: list[dict[str, Any]] = []
        while len(told) < 4:
            if isinstance(message := it.recv(timeout=10), str) and json.loads(message)["op"] == "status":
                told.append(json.loads(message))
    assert {one["level"] for one in told} == {2}
    assert keyed.app.state.ros.graph.topics == before


# ------------------------------------------------------------------ the viewer


@pytest.fixture(scope="module")
def viewer() -> Iterator[Viewer]:
    it = Viewer(wall_store(), Access(ServiceSettings()), port=0)
    it.start()
    yield it
    it.stop()


def _viser(viewer: Viewer, **more: Any) -> Connection:
    """Connect as viser's page does."""
    protocol = Subprotocol(f"viser-v{viser.__version__}")
    return connect(f"ws://127.0.0.1:{viewer.port}/", subprotocols=[protocol], max_size=None, **more)


def test_the_viewer_needs_the_key_once_and_then_its_cookie(viewer: Viewer) -> None:
    url, key = f"http://127.0.0.1:{viewer.port}", read_key(key_file())
    with httpx.Client(base_url=url) as browser:
        for path in ("/", "/?key=", "/?key=spb_guess", "/assets/x.js"):
            answer = browser.get(path)
            assert (answer.status_code, "?key=KEY" in answer.text) == (401, True), path
        entered = browser.get(f"/?key={key}")
        assert entered.status_code == 200
        cookie = entered.headers["set-cookie"]
        assert {"HttpOnly", "SameSite=Strict"} <= {part.strip() for part in cookie.split(";")}
        assert str(key) not in cookie + entered.text
        assert "<script" in browser.get("/").text  # the page of viser
        ticket = cookie.partition(";")[0]
        for wrong in (ticket[:-1], ticket.partition("=")[0] + "=", "a=b; " + ticket.upper(), "[]=;;="):
            assert httpx.get(url, headers={"Cookie": wrong}).status_code == 401
    for stranger in ({}, {"Cookie": ticket[:-2]}):
        with pytest.raises(InvalidStatus) as caught, _viser(viewer, additional_headers=stranger):
            pass
        assert caught.value.response.status_code == 401
    with _viser(viewer, additional_headers={"Cookie": ticket}, origin=Origin(url)) as socket:
        assert len(socket.recv(timeout=10)) > 0


def test_the_viewer_refuses_pages_of_other_sites_and_rebound_names(viewer: Viewer) -> None:
    url, key = f"http://127.0.0.1:{viewer.port}", read_key(key_file())
    ticket = httpx.get(f"{url}/?key={key}").headers["set-cookie"].partition(";")[0]
    for origin in (EVIL, "null", "http://127.0.0.1:1"):
        with (
            pytest.raises(InvalidStatus) as caught,
            _viser(viewer, additional_headers={"Cookie": ticket}, origin=Origin(origin)),
        ):
            pass
        assert caught.value.response.status_code == 403
    rebound = httpx.get(f"{url}/?key={key}", headers={"Host": f"evil.example:{viewer.port}", "Cookie": ticket})
    assert rebound.status_code == 421


def test_the_viewer_refuses_more_viewers_than_it_can_draw_for() -> None:
    viewer = Viewer(wall_store(), Access(ServiceSettings(insecure_no_auth=True)), port=0)
    viewer.start()
    try:
        with ExitStack() as open_:
            sockets = [open_.enter_context(_viser(viewer)) for _ in range(32)]
            for socket in sockets:
                assert len(socket.recv(timeout=20)) > 0
            with pytest.raises(InvalidStatus) as caught, _viser(viewer):
                pass
            assert caught.value.response.status_code == 503
        deadline = time.monotonic() + 30
        while time.monotonic() < deadline:  # the closed ones make room
            with suppress(InvalidStatus), _viser(viewer) as again:
                assert len(again.recv(timeout=20)) > 0
                return
        pytest.fail("no viewer was let in after all had gone")
    finally:
        viewer.stop()


def test_a_server_that_only_draws_a_page_serves_nobody() -> None:
    server = open_server("127.0.0.1", 0)
    try:
        assert httpx.get(f"http://127.0.0.1:{server.get_port()}/").status_code == 403
    finally:
        close_server(server)


def test_a_viewer_of_a_service_without_keys_is_open_to_this_machine_alone() -> None:
    viewer = Viewer(wall_store(), Access(ServiceSettings(insecure_no_auth=True)), port=0)
    viewer.start()
    try:
        url = f"http://127.0.0.1:{viewer.port}/"
        assert httpx.get(url).status_code == 200
        assert httpx.get(url, headers={"Host": "evil.example"}).status_code == 421
        with pytest.raises(InvalidStatus), _viser(viewer, origin=Origin(EVIL)):
            pass
    finally:
        viewer.stop()


# ------------------------------------------------------------------ logs, proxies, smuggling


@pytest.mark.parametrize("formatter", [TextFormatter(), JsonFormatter()], ids=["text", "json"])
def test_keys_reach_no_log_and_paths_forge_no_line(
    home: Service, formatter: logging.Formatter, capfd: pytest.CaptureFixture[str]
) -> None:
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(formatter)
    root = logging.getLogger()
    root.addHandler(handler)
    root.setLevel(logging.DEBUG)
    try:
        assert home.key is not None
        with connect(home.ws("/rosbridge")):
            pass
        wrong = "spb_" + "x" * 43
        with pytest.raises(InvalidStatus), connect(home.ws("/rosbridge").partition("?")[0] + f"?a=1&api_key={wrong}"):
            pass
        with pytest.raises(InvalidStatus), connect(home.ws("/nowhere")):
            pass
        home.client.get(f"/v1/maps/{home.key}")
        home.client.get(f"/v1/maps?api_key={home.key}")
        home.client.get("/v1/maps/x%0aINFO:%20forged%0d%1b[2J%e2%80%ae")
        logging.getLogger("x").warning("GET /?api_key=%s", home.key)
        try:
            raise ValueError(f"{home.key}\nERROR: forged")
        except ValueError:
            logging.getLogger("x").exception("failed")
    finally:
        root.removeHandler(handler)
    time.sleep(0.2)
    said = capfd.readouterr().err
    assert home.key not in said
    assert wrong not in said
    assert "/v1/maps/***" in said
    assert "WebSocket /rosbridge" in said
    assert not re.search(r"^(INFO: forged|ERROR: forged)", said, re.MULTILINE)
    assert not re.search("[\x00-\x09\x0b-\x1f\u202e]", said)


def test_x_forwarded_for_counts_only_from_a_configured_proxy() -> None:
    asked = {"X-Forwarded-For": "203.0.113.9", "X-Forwarded-Proto": "https"}
    with running(ServiceSettings(insecure_no_auth=True)) as service:
        assert service.client.post("/v1/stop", headers=asked).json()["by"] == "127.0.0.1"
    with pytest.raises(ConfigError, match="api_keys"):
        check_exposure(ServiceSettings(trusted_proxies=("127.0.0.1",)))
    with running(ServiceSettings(insecure_no_auth=True, trusted_proxies=("127.0.0.1",))) as service:
        assert service.client.post("/v1/stop", headers=asked).json()["by"] == "203.0.113.9"


@pytest.mark.parametrize("path", ["/v1/maps/wall/distance", "/healthz", "/nowhere"])
def test_a_request_of_two_lengths_is_refused_and_ends_the_connection(home: Service, path: str) -> None:
    hidden = "DELETE /v1/maps/wall HTTP/1.1\r\nHost: localhost\r\n\r\n"
    for lengths in (
        "Content-Length: 5\r\nTransfer-Encoding: chunked",
        "Transfer-Encoding: chunked\r\nContent-Length: 5",
        "Content-Length: 5\r\ntransfer-encoding:chunked",
        "Content-Length: 5\r\nContent-Length: 6",
        "Content-Length: 5\r\nTransfer-Encoding: identity",
    ):
        head = f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n{lengths}\r\n\r\n"
        status, data = _raw(home, f"{head}0\r\n\r\n{hidden}")
        assert status in (400, 501), data
        assert data.count(b"HTTP/1.1") == 1, data
    for twice in ("Host: localhost\r\nHost: evil.example", "X: y"):
        assert _raw(home, f"GET {path} HTTP/1.1\r\n{twice}\r\nConnection: close\r\n\r\n")[0] == 400
    assert home.store.get("wall").map_version == 1


def test_probes_name_no_maps(home: Service) -> None:
    home.store.add("secret-project", source="a log", state="mapping")
    try:
        with _stranger(home) as stranger:
            probes = [stranger.get(path) for path in ("/healthz", "/readyz")]
        assert [probe.status_code for probe in probes] == [200, 503]
        assert not any("wall" in probe.text or "secret" in probe.text for probe in probes)
    finally:
        home.store.remove("secret-project")


# ------------------------------------------------------------------ the command


def test_the_command_prints_keys_with_scopes_and_refuses_others() -> None:
    command = [sys.executable, "-m", "splatbot", "serve"]
    done = subprocess.run([*command, "--new-key", "--scopes", "read,move"], capture_output=True, text=True, timeout=60)
    assert done.returncode == 0, done.stderr
    assert re.search(r"SPLATBOT_API_KEYS=sha256:[0-9a-f]{64}:read\+move$", done.stdout.strip())
    for wrong, named in ((["--new-key", "--scopes", "write"], "write"), (["--scopes", "read"], "--new-key")):
        done = subprocess.run([*command, *wrong], capture_output=True, text=True, timeout=60)
        assert (done.returncode, named in done.stderr, "Traceback" in done.stderr) == (2, True, False)


def test_a_service_tells_the_file_of_its_key_and_writes_the_key_to_no_pipe(tmp_path: Path) -> None:
    wall().model.save(tmp_path / "map.ply")
    state = {"XDG_STATE_HOME": str(tmp_path / "state")}
    command = [sys.executable, "-m", "splatbot", "serve", "--map", str(tmp_path), "--port", "0"]
    for options, warned in (([], False), (["--insecure-no-auth"], True)):
        process = subprocess.Popen(
            [*command, *options], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=os.environ | state
        )
        try:
            assert process.stdout is not None
            url = re.search(r"http://\S+", process.stdout.readline())
            assert url is not None
            with httpx.Client(base_url=url[0], timeout=60) as client:
                assert client.delete("/v1/maps/default").status_code == (204 if warned else 401)
        finally:
            process.terminate()
            out, err = process.communicate(timeout=30)
        key = read_key(tmp_path / "state" / "splatbot" / "service-key")
        assert key is not None
        assert key not in out + err
        assert ("service-key" in out) is not warned
        assert ("insecure_no_auth" in err) is warned


# ------------------------------------------------------------------ the page of the routes


def test_the_docs_run_scripts_of_the_service_alone(home: Service) -> None:
    page = home.client.get("/docs")
    assert "default-src 'self'" in page.headers["content-security-policy"]
    assert "unsafe" not in page.headers["content-security-policy"].replace("style-src 'self' 'unsafe-inline'", "")
    sources = re.findall(r'(?:src|href)="([^"]+)"', page.text)
    assert len(sources) == 4
    for source in sources:
        assert source.startswith("/docs/"), source
        assert home.client.get(source).status_code == 200
    assert home.client.get("/docs/assets/../../etc/passwd").status_code == 404
    assert home.client.get("/docs/assets/%2e%2e/core.py").status_code == 404
    assert home.client.get("/redoc").status_code == 404


def test_methods_of_a_client_s_own_make_no_metric_series(home: Service) -> None:
    def series() -> int:
        return len(home.client.get("/metrics").text.splitlines())

    for number in range(2):
        home.client.request(f"ODD{number}", "/v1/maps")
        home.client.request(f"ODD{number}", f"/nowhere{number}")
    series()  # a request of /metrics has its own series from the next one on
    before = series()
    for number in range(20):
        home.client.request(f"STRANGE{number}", "/v1/maps")
        home.client.request(f"STRANGE{number}", f"/nowhere{number}")
    assert series() == before

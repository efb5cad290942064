"""Pages of another origin, and of a name that is rebound to this machine, against the service in Chromium."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, HTTPServer
from pathlib import Path
from typing import Any

import pytest

from splatbot.services.access import Access
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from splatbot.services.viewer.viewer import Viewer
from tests.browser.chromium import Chromium
from tests.contracts.conftest import Service, running, wall

pytestmark = [pytest.mark.long, pytest.mark.alone]

ATTACK = """
(async (service, viewer, query) => {
  const told = {};
  const ask = async (name, path, options) => {
    try { told[name] = (await fetch(service + path, options)).status; } catch (error) { told[name] = "blocked"; }
  };
  const open = (name, url, protocols) => new Promise(done => {
    const socket = new WebSocket(url, protocols);
    socket.onopen = () => { told[name] = "open"; done(); };
    socket.onerror = () => { told[name] = "refused"; done(); };
  });
  const blob = new Blob(['{"id": "evil"}']);
  await ask("delete", "/v1/maps/wall", {method: "DELETE"});
  await ask("json", "/v1/maps", {method: "POST", headers: {"Content-Type": "application/json"}, body: blob});
  await ask("blob", "/v1/maps", {method: "POST", mode: "no-cors", body: blob});
  await ask("stop", "/v1/stop", {method: "POST", mode: "no-cors"});
  await ask("read", "/v1/maps", {});
  const socket = service.replace("http", "ws");
  for (const path of ["/", "/rosbridge"]) await open(path, socket + path + query);
  await open("/foxglove", socket + "/foxglove" + query, ["foxglove.sdk.v1"]);
  await open("viewer", viewer.replace("http", "ws"), ["viser-v0"]);
  return told;
})"""


class _Page(BaseHTTPRequestHandler):
    def do_GET(self) -> None:
        self.send_response(200)
        self.send_header("Content-Type", "text/html")
        self.end_headers()
        self.wfile.write(b"<!doctype html><title>a page of somebody else</title>")

    def log_message(self, *_: Any) -> None:
        """Log nothing."""


@pytest.fixture
def somebody_else() -> Iterator[int]:
    """The port of a web server of another origin on this machine."""
    server = HTTPServer(("127.0.0.1", 0), _Page)
    threading.Thread(target=server.serve_forever, daemon=True).start()
    yield server.server_port
    server.shutdown()
    server.server_close()


def _attack(browser: Chromium, page: str, service: str, viewer: str, query: str) -> dict[str, Any]:
    """Let a page attack the service and the viewer at the given addresses."""
    browser.open(page)
    for _ in range(100):
        time.sleep(0.1)
        if browser.evaluate("document.readyState == 'complete' ? location.href : ''") == page:
            break
    script = f"{ATTACK}({json.dumps(service)}, {json.dumps(viewer)}, {json.dumps(query)})"
    return dict(browser.evaluate(script))


def _unharmed(service: Service) -> bool:
    maps = [m["id"] for m in service.client.get("/v1/maps").json()["maps"]]
    return maps == ["wall"] and service.client.get("/v1/stop").json()["stopped"] is False


@pytest.mark.parametrize("insecure", [False, True], ids=["with a key", "insecure_no_auth"])
def test_pages_of_others_and_rebound_names_change_nothing_and_open_no_socket(
    tmp_path: Path, somebody_else: int, insecure: bool
) -> None:
    settings = ServiceSettings(insecure_no_auth=insecure)
    store = MapStore()
    store.add("wall", source="wall.ply", state="static", snapshot=wall())
    flags = ("--host-resolver-rules=MAP evil.example 127.0.0.1",)
    with running(settings, store) as service, Chromium(tmp_path / "profile", flags=flags) as browser:
        viewer = Viewer(store, Access(settings), port=0)
        viewer.start()
        try:
            port, query = service.client.base_url.port, f"?api_key={service.key}"
            page = f"http://127.0.0.1:{viewer.port}"
            for host in ("127.0.0.1", "evil.example"):
                told = _attack(browser, f"http://{host}:{somebody_else}/", service.url, page, query)
                assert {told[name] for name in ("/", "/rosbridge", "/foxglove", "viewer")} == {"refused"}, told
                assert {told[name] for name in ("delete", "json", "read")} == {"blocked"}, told
                assert _unharmed(service), told
            rebound, door = f"http://evil.example:{port}", f"http://evil.example:{viewer.port}"
            told = _attack(browser, f"{rebound}/healthz", rebound, door, query)
            assert {told[name] for name in ("/", "/rosbridge", "/foxglove", "viewer")} == {"refused"}, told
            assert {told[name] for name in ("delete", "json", "blob", "stop", "read")} == {421}, told
            assert _unharmed(service), told
        finally:
            viewer.stop()


def test_the_page_of_the_service_may_ask_itself(tmp_path: Path) -> None:
    store = MapStore()
    store.add("wall", source="wall.ply", state="static", snapshot=wall())
    with running(ServiceSettings(), store) as service, Chromium(tmp_path / "profile") as browser:
        told = _attack(browser, f"{service.url}/healthz", service.url, "http://127.0.0.1:1", f"?api_key={service.key}")
        assert {told[name] for name in ("/", "/rosbridge", "/foxglove")} == {"open"}, told
        assert (told["read"], told["delete"], told["json"]) == (200, 401, 401), told

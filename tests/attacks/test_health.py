"""Attacks on the answers of the service: work that piles up, silent clients, connections without end."""

from __future__ import annotations

import contextlib
import resource
import socket
import tempfile
import threading
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

import httpx
import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect

from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.services.queues import AT_ONCE, Queues
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore
from splatbot.serving import serving
from tests.contracts.conftest import Service, running, wall
from tests.waiting import until

URGENT = (("GET", "/healthz"), ("GET", "/readyz"), ("GET", "/metrics"), ("POST", "/v1/stop"))


def store() -> MapStore:
    maps = MapStore()
    maps.add("default", source="wall.ply", state="static", snapshot=wall())
    return maps


@pytest.fixture
def served() -> Iterator[Service]:
    with running(ServiceSettings(), store()) as service:
        yield service


def other(service: Service) -> httpx.Client:
    return httpx.Client(base_url=service.url, headers=dict(service.client.headers), timeout=30)


class Blocked:
    """Requests to a path that do not end before the block does."""

    def __init__(self, service: Service, path: str, number: int) -> None:
        self.service, self.path, self.number = service, path, number
        self.gate, self.entered = threading.Event(), threading.Semaphore(0)
        self.statuses: list[int] = []

    def __enter__(self) -> Blocked:
        def slow() -> None:
            self.entered.release()
            self.gate.wait(60)

        self.service.app.add_api_route(self.path, slow, methods=["GET"])

        def ask() -> None:
            with other(self.service) as client:
                self.statuses.append(client.get(self.path).status_code)

        self.threads = [threading.Thread(target=ask) for _ in range(self.number)]
        for thread in self.threads:
            thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self.gate.set()
        for thread in self.threads:
            thread.join(30)


def waiting(service: Service, kind: str) -> int:
    """Return the number of requests of a kind that wait for a place."""
    layer: Any = service.app.middleware_stack
    while not isinstance(layer, Queues):
        layer = layer.app
    return layer._waiting[kind]


@pytest.mark.parametrize("path", ["/v1/maps/x/plans", "/slow"])
def test_health_metrics_and_stop_do_not_wait_behind_work(served: Service, path: str) -> None:
    with Blocked(served, path, 64) as blocked:
        kind = "plans" if "plans" in path else "others"
        for _ in range(AT_ONCE[kind]):
            assert blocked.entered.acquire(timeout=20)
        until(lambda: waiting(served, kind) == 64 - AT_ONCE[kind])
        for method, urgent in URGENT:
            begin = time.monotonic()
            response = served.client.request(method, urgent, timeout=5)
            assert (response.status_code, time.monotonic() - begin < 2) == (200, True), urgent
        assert served.runtime.arms.emergency_stop is not None
    assert set(blocked.statuses) == {200}


def test_one_kind_of_work_does_not_keep_another_waiting(served: Service) -> None:
    with Blocked(served, "/v1/maps/x/plans", 30) as blocked:
        for _ in range(AT_ONCE["plans"]):
            assert blocked.entered.acquire(timeout=20)
        answer = served.client.post("/v1/maps/default/distance", json={"points": [[0, 0, 1]]}, timeout=10)
        assert answer.status_code == 200
        assert served.client.get("/v1/maps", timeout=10).status_code == 200


def test_a_full_queue_is_503_with_a_time_to_come_again() -> None:
    with (
        running(ServiceSettings(max_waiting=2), store()) as service,
        Blocked(service, "/v1/maps/x/plans", AT_ONCE["plans"] + 2) as blocked,
    ):
        for _ in range(AT_ONCE["plans"]):
            assert blocked.entered.acquire(timeout=20)
        until(lambda: waiting(service, "plans") == 2)
        refused = service.client.get("/v1/maps/x/plans")
        assert (refused.status_code, refused.headers["retry-after"]) == (503, "1")
        assert "2 requests of the kind 'plans' wait" in refused.json()["detail"]


def test_a_client_that_leaves_gives_up_its_place_in_the_queue(served: Service) -> None:
    with Blocked(served, "/v1/maps/x/plans", AT_ONCE["plans"]) as blocked:
        for _ in range(AT_ONCE["plans"]):
            assert blocked.entered.acquire(timeout=20)
        line = raw(served, f"GET /v1/maps/x/plans HTTP/1.1\r\nHost: 127.0.0.1\r\n{key_line(served)}\r\n")
        until(lambda: waiting(served, "plans") == 1)
        line.close()
        until(lambda: waiting(served, "plans") == 0)
    assert not blocked.entered.acquire(timeout=1)


def raw(service: Service, text: str = "", source: str = "127.0.0.1") -> socket.socket:
    port = service.client.base_url.port
    assert port is not None
    line = socket.create_connection(("127.0.0.1", port), timeout=20, source_address=(source, 0))
    line.sendall(text.encode())
    return line


def key_line(service: Service) -> str:
    return "".join(f"{n}: {v}\r\n" for n, v in service.client.headers.items() if n.lower() == "authorization")


def ended(line: socket.socket, within_s: float) -> bool:
    line.settimeout(within_s)
    try:
        return line.recv(1) == b"" or ended(line, within_s)
    except ConnectionError:
        return True
    except TimeoutError:
        return False


@pytest.mark.parametrize("text", ["", "GET /v1/maps HTTP/1.1\r\nHost: 127.0.0.1\r\nX-A: "])
def test_a_silent_connection_and_half_a_header_are_closed(text: str) -> None:
    with running(ServiceSettings(idle_s=0.5), store()) as service:
        line = raw(service, text)
        assert ended(line, 5)
        assert service.client.get("/healthz").status_code == 200


def test_a_header_that_drips_is_closed() -> None:
    with running(ServiceSettings(idle_s=0.5), store()) as service:
        line = raw(service, "GET /v1/maps HTTP/1.1\r\nHost: 127.0.0.1\r\n")
        begin = time.monotonic()
        with contextlib.suppress(BrokenPipeError, ConnectionResetError):
            while time.monotonic() < begin + 10:
                line.sendall(b"X")
                time.sleep(0.1)
        assert time.monotonic() - begin < 5


@pytest.mark.parametrize("path", ["/v1/maps/default/distance", "/v1/maps/new/upload"])
def test_a_body_that_does_not_come_is_408(path: str) -> None:
    with running(ServiceSettings(body_s=0.5), store()) as service:
        kind = "application/zip" if "upload" in path else "application/json"
        head = f"POST {path} HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: {kind}\r\nContent-Length: 100\r\n"
        line = raw(service, head + key_line(service) + "\r\n{")
        line.settimeout(5)
        assert b" 408 " in line.recv(200)


def test_slow_bodies_take_no_place_of_work(served: Service) -> None:
    head = "POST /v1/maps/default/distance HTTP/1.1\r\nHost: 127.0.0.1\r\nContent-Type: application/json\r\n"
    lines = [raw(served, head + key_line(served) + "Content-Length: 100\r\n\r\n{") for _ in range(40)]
    time.sleep(0.3)
    answer = served.client.post("/v1/maps/default/distance", json={"points": [[0, 0, 1]]}, timeout=5)
    assert answer.status_code == 200
    for line in lines:
        line.close()


def test_idle_connections_make_room_for_those_that_ask() -> None:
    settings = ServiceSettings(max_connections=32, max_client_connections=16, idle_s=60)
    with running(settings, store()) as service:
        lines = [raw(service) for _ in range(64)]
        lines += [raw(service, source=f"127.0.0.{n}") for n in range(2, 66)]
        for _ in range(3):
            assert httpx.get(f"{service.url}/healthz", timeout=5).status_code == 200
        assert ended(lines[0], 5)
        for line in lines:
            line.close()


def test_streams_of_one_client_are_bounded() -> None:
    with running(ServiceSettings(max_client_streams=3), store()) as service:
        streams = [connect(service.ws("/rosbridge")) for _ in range(3)]
        with pytest.raises(InvalidStatus):
            connect(service.ws("/rosbridge"))
        streams.pop().close()

        def takes_another() -> bool:
            with contextlib.suppress(InvalidStatus):
                streams.append(connect(service.ws("/rosbridge")))
            return len(streams) == 3

        until(takes_another)
        for stream in streams:
            stream.close()


class Probe:
    """A client that requests /healthz on one connection, and little else."""

    def __init__(self, url: str) -> None:
        self.line = socket.create_connection(("127.0.0.1", int(url.rsplit(":", 1)[1])), timeout=20)

    def __enter__(self) -> Probe:
        self.seconds()
        return self

    def __exit__(self, *_: object) -> None:
        self.line.close()

    def seconds(self) -> float:
        begin = time.perf_counter()
        self.line.sendall(b"GET /healthz HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n")
        answer = self.line.recv(4096)
        assert b" 200 " in answer
        while b'"ok"' not in answer:
            answer += self.line.recv(4096)
        return time.perf_counter() - begin


@pytest.fixture(scope="module")
def process(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, Path]]:
    """A service of its own process, whose files are limited to 256; its URL and its log."""
    folder = tmp_path_factory.mktemp("served")
    wall().model.save(folder / "map.ply")
    before = resource.getrlimit(resource.RLIMIT_NOFILE)
    resource.setrlimit(resource.RLIMIT_NOFILE, (256, before[1]))
    try:
        command = serving("--map", str(folder), log=folder / "log.txt")
        with command as it:
            resource.prlimit(it.process.pid, resource.RLIMIT_NOFILE, (256, 256))
            resource.setrlimit(resource.RLIMIT_NOFILE, before)
            yield it.url, folder / "log.txt"
    finally:
        resource.setrlimit(resource.RLIMIT_NOFILE, before)


@pytest.mark.long
@pytest.mark.alone
def test_idle_sockets_beyond_the_files_of_the_process_do_not_make_it_deaf(process: tuple[str, Path]) -> None:
    url, log = process
    port = int(url.rsplit(":", 1)[1])
    lines = []
    for number in range(400):
        lines.append(socket.create_connection(("127.0.0.1", port), source_address=(f"127.0.0.{2 + number % 8}", 0)))
    time.sleep(1)
    for _ in range(5):
        assert httpx.get(f"{url}/healthz", timeout=5).status_code == 200
    for line in lines:
        line.close()
    assert len(log.read_text().splitlines()) < 40


@pytest.mark.long
@pytest.mark.alone
def test_health_is_quick_while_50_plans_are_asked_for(process: tuple[str, Path]) -> None:
    url, _ = process
    base = {"translation": [0.0, 0.5, -1.0], "quaternion_wxyz": [0.7071068, 0.7071068, 0.0, 0.0]}
    body = {"goal": [0.3, -0.785, 0.0, -2.356, 0.0, 1.571, 0.785], "base": base, "budget_ms": 1000}
    seconds: list[float] = []
    with ThreadPoolExecutor(50) as clients, httpx.Client(base_url=url, timeout=60) as planner, Probe(url) as probe:
        asked = [clients.submit(planner.post, "/v1/maps/default/plans", json=body) for _ in range(100)]
        while not all(one.done() for one in asked):
            seconds.append(probe.seconds())
            time.sleep(0.01)
        statuses = [one.result().status_code for one in asked]
    print(f"{len(seconds)} probes, p50 {np.median(seconds):.4f} s, p99 {np.quantile(seconds, 0.99):.4f} s")
    assert set(statuses) == {200}
    assert np.quantile(seconds, 0.99) < 0.1


def test_a_client_that_does_not_read_is_cut_off(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    maps, n = store(), 200_000
    big = GaussianModel.from_activated(
        means=np.random.default_rng(0).normal(size=(n, 3)),
        quats=np.tile([1.0, 0, 0, 0], (n, 1)),
        scales=np.full((n, 3), 0.01),
        opacities=np.full(n, 0.9),
        colors=np.full((n, 3), 0.5),
    )
    maps.add("big", source="big.ply", state="static", snapshot=Snapshot(big, 1))
    with running(ServiceSettings(body_s=1.0), maps) as service:
        request = "GET /v1/maps/big/splats.ply HTTP/1.1\r\nHost: 127.0.0.1\r\n\r\n"
        lines = [raw(service, request) for _ in range(AT_ONCE["exports"] + 2)]  # two wait for those that do not read
        deadline = time.monotonic() + 120
        while answered(service, "splats") < len(lines):
            assert len(list(tmp_path.glob("splatbot-export-*"))) <= AT_ONCE["exports"]
            assert time.monotonic() < deadline
            time.sleep(0.1)
        for line in lines:
            line.close()
    assert list(tmp_path.glob("splatbot-export-*")) == []


def answered(service: Service, route: str) -> int:
    """Return the number of requests of a route that have ended."""
    lines = service.client.get("/metrics").text.splitlines()
    counts = [line for line in lines if line.startswith("splatbot_request_seconds_count") and route in line]
    return sum(int(float(line.split()[-1])) for line in counts)

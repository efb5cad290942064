"""Keys, limits, uploads and bytes that mean harm, against a real server."""

from __future__ import annotations

import gc
import io
import json
import random
import shutil
import socket
import ssl
import struct
import subprocess
import threading
import time
import zipfile
import zlib
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import httpx
import msgpack
import numpy as np
import pytest
from websockets.exceptions import InvalidStatus
from websockets.sync.client import connect
from websockets.typing import Subprotocol

from splatbot.client import Client, ServiceError, pack_array
from splatbot.errors import ConfigError
from splatbot.logs import open_log
from splatbot.logs.record import record
from splatbot.services.codecs import encode_npy
from splatbot.services.keys import hash_key, known_key, new_key
from splatbot.services.runtime import check_exposure
from splatbot.services.settings import ServiceSettings, load_settings
from tests.contracts.conftest import Service, running, wall_store
from tests.waiting import until

KEYS = (new_key(), new_key())


@pytest.fixture(scope="module")
def locked() -> Iterator[Service]:
    with running(ServiceSettings(api_keys=tuple(hash_key(key) for key in KEYS)), wall_store()) as service:
        yield service


@pytest.fixture(scope="module")
def open_() -> Iterator[Service]:
    settings = ServiceSettings(
        max_upload_bytes=2_000_000, max_unpacked_bytes=3_000_000, max_body_bytes=300_000, requests_per_s=1e6
    )
    with running(settings, wall_store()) as service:
        yield service


@pytest.mark.parametrize("key", KEYS, ids=["first", "second"])
@pytest.mark.parametrize("header", ["Authorization", "X-API-Key"])
def test_each_key_opens_in_either_header(locked: Service, key: str, header: str) -> None:
    value = f"Bearer {key}" if header == "Authorization" else key
    assert locked.client.get("/v1/maps", headers={header: value}).status_code == 200


@pytest.mark.parametrize(
    "headers",
    [
        {},
        {"Authorization": "Bearer x"},
        {"Authorization": f"Basic {KEYS[0]}"},
        {"Authorization": f"Bearer {KEYS[0]}x"},
        {"X-API-Key": hash_key(KEYS[0])},
        {"X-API-Key": "\xff"},
    ],
)
def test_strangers_are_refused_everywhere_but_at_the_probes(locked: Service, headers: dict[str, str]) -> None:
    raw = [(name.encode(), value.encode("latin-1")) for name, value in headers.items()]
    for path in ("/v1/maps", "/docs", "/openapi.json", "/metrics", "/nowhere"):
        response = locked.client.get(path, headers=raw)
        assert response.status_code == 401, path
        assert response.headers["content-type"] == "application/problem+json"
        assert response.headers["www-authenticate"] == "Bearer"
    assert locked.client.get("/healthz", headers=raw).status_code == 200
    assert locked.client.get("/readyz", headers=raw).status_code == 200


@pytest.mark.parametrize("path", ["/rosbridge", "/foxglove", "/"])
def test_websockets_of_strangers_are_refused_and_a_key_may_stand_in_their_url(locked: Service, path: str) -> None:
    url = locked.url.replace("http://", "ws://") + path
    for stranger in (url, f"{url}?api_key=spb_guess"):
        with pytest.raises(InvalidStatus) as caught, connect(stranger):
            pass
        assert caught.value.response.status_code == 403
    protocols = [Subprotocol("foxglove.sdk.v1")] if path == "/foxglove" else None
    with connect(f"{url}?api_key={KEYS[0]}", subprotocols=protocols) as socket:
        assert socket.protocol.state.name == "OPEN"


def test_a_key_is_known_by_its_hash_alone_and_nothing_keeps_the_key() -> None:
    hashes = [hash_key(key) for key in KEYS]
    assert known_key(KEYS[1], hashes) == hashes[1]
    assert known_key(hashes[0], hashes) is None
    assert known_key("", hashes) is None
    assert len(new_key()) >= 43
    assert new_key() != new_key()


def test_a_service_that_others_can_reach_does_not_start_without_keys() -> None:
    for host in ("0.0.0.0", "::", "192.168.1.5", "robot.local"):
        with pytest.raises(ConfigError, match="api_keys"):
            check_exposure(ServiceSettings(host=host))
        check_exposure(ServiceSettings(host=host, api_keys=(hash_key(KEYS[0]),)))
    for host in ("127.0.0.1", "127.0.0.9", "::1", "localhost"):
        check_exposure(ServiceSettings(host=host))


def test_tls_is_whole_or_refused(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="tls_cert"):
        check_exposure(ServiceSettings(tls_cert=tmp_path / "a.pem"))
    with pytest.raises(ConfigError, match="does not exist"):
        check_exposure(ServiceSettings(tls_cert=tmp_path / "a.pem", tls_key=tmp_path / "b.pem"))


@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificate")
def test_a_service_with_a_certificate_speaks_https_to_those_who_trust_it_alone(tmp_path: Path) -> None:
    cert, key = tmp_path / "cert.pem", tmp_path / "key.pem"
    make = ["openssl", "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes"]
    make += ["-keyout", str(key), "-out", str(cert), "-days", "2", "-subj", "/CN=localhost"]
    make += ["-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1"]
    subprocess.run(make, check=True, capture_output=True)
    settings = ServiceSettings(tls_cert=cert, tls_key=key)
    check_exposure(settings)
    with running(settings, wall_store()) as service:
        trusting = ssl.create_default_context(cafile=str(cert))
        with Client(service.url, tls=trusting) as client:
            assert client.maps()[0]["id"] == "wall"
        with Client(service.url) as stranger, pytest.raises(ServiceError, match="CERTIFICATE_VERIFY_FAILED"):
            stranger.maps()
        with Client(service.url.replace("https", "http")) as plain, pytest.raises(ServiceError, match="no answer"):
            plain.maps()


def test_keys_come_from_the_environment_separated_by_commas(monkeypatch: pytest.MonkeyPatch) -> None:
    hashes = [hash_key(key) for key in KEYS]
    monkeypatch.setenv("SPLATBOT_API_KEYS", ", ".join(hashes))
    assert load_settings().api_keys == tuple(hashes)
    monkeypatch.setenv("SPLATBOT_API_KEYS", KEYS[0])
    with pytest.raises(ConfigError, match="no hash of a key"):
        load_settings()


def test_pages_of_other_origins_may_not_ask_unless_they_are_named() -> None:
    asked = {"Origin": "https://evil.example", "Access-Control-Request-Method": "POST"}
    with running(ServiceSettings(), wall_store()) as service:
        assert "access-control-allow-origin" not in service.client.options("/v1/maps", headers=asked).headers
    with running(ServiceSettings(cors_origins=("https://ui.example",)), wall_store()) as service:
        assert "access-control-allow-origin" not in service.client.get("/v1/maps", headers=asked).headers
        named = service.client.get("/v1/maps", headers={"Origin": "https://ui.example"})
        assert named.headers["access-control-allow-origin"] == "https://ui.example"


def test_a_hasty_client_is_told_when_to_come_again_and_others_are_served(monkeypatch: pytest.MonkeyPatch) -> None:
    hashes = tuple(hash_key(key) for key in KEYS)
    now = [100.0]
    monkeypatch.setattr("splatbot.services.guard.time", SimpleNamespace(monotonic=lambda: now[0]))
    with running(ServiceSettings(requests_per_s=5, api_keys=hashes), wall_store()) as service:
        hasty = []
        for _ in range(30):  # within 1 s on the clock of the limit, however busy the machine is
            now[0] += 1 / 30
            hasty.append(service.client.get("/v1/maps", headers={"X-API-Key": KEYS[0]}))
        refused = [response for response in hasty if response.status_code == 429]
        assert 10 <= len(refused) <= 20
        assert all(int(response.headers["retry-after"]) >= 1 for response in refused)
        assert service.client.get("/v1/maps", headers={"X-API-Key": KEYS[1]}).status_code == 200


def test_one_request_too_many_at_once_is_503_and_the_probes_still_answer() -> None:
    with running(ServiceSettings(max_requests=1), wall_store()) as service:
        gate, entered = threading.Event(), threading.Event()

        def slow() -> None:
            entered.set()
            gate.wait(20)

        service.app.add_api_route("/slow", slow)
        with httpx.Client(base_url=service.url, timeout=30) as other:
            waiting = threading.Thread(target=lambda: other.get("/slow"))
            waiting.start()
            assert entered.wait(10)
            response = service.client.get("/v1/maps")
            assert (response.status_code, response.headers["retry-after"]) == (503, "1")
            assert service.client.get("/healthz").status_code == 200
            gate.set()
            waiting.join(10)
        assert service.client.get("/v1/maps").status_code == 200


def _zip(files: dict[str, bytes]) -> bytes:
    data = io.BytesIO()
    with zipfile.ZipFile(data, "w", zipfile.ZIP_DEFLATED) as pack:
        for name, content in files.items():
            pack.writestr(name, content)
    return data.getvalue()


def _recording(folder: Path) -> dict[str, bytes]:
    home = record(open_log("synthetic:tabletop?frames=4&width=160&height=120&arc=4"), folder / "log")
    return {f"log/{p.relative_to(home)}": p.read_bytes() for p in home.rglob("*") if p.is_file()}


def _upload(service: Service, map_id: str, data: bytes) -> dict[str, object]:
    response = service.client.post(
        f"/v1/maps/{map_id}/upload", content=data, headers={"Content-Type": "application/zip"}
    )
    assert response.status_code == 202, response.text
    place = response.headers["location"]
    deadline = time.monotonic() + 60
    while (job := service.client.get(place).json())["state"] in ("queued", "running"):
        assert time.monotonic() < deadline
        time.sleep(0.02)
    return dict(job)


def test_an_uploaded_recording_is_mapped(open_: Service, tmp_path: Path) -> None:
    scene = b"gravity: [0.0, 0.0, -1.0]\n"
    job = _upload(open_, "sent", _zip(_recording(tmp_path) | {"log/scene.yaml": scene}))
    assert job["state"] == "succeeded", job
    assert open_.client.get("/v1/maps/sent").json()["gaussians"] > 500


def _png_of(width: int, height: int) -> bytes:
    def chunk(kind: bytes, data: bytes) -> bytes:
        return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))

    head = struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0)
    return b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", head) + chunk(b"IDAT", zlib.compress(b"\0")) + chunk(b"IEND", b"")


def test_uploads_that_mean_harm_fail_and_leave_nothing(open_: Service, tmp_path: Path) -> None:
    good = _recording(tmp_path)
    lists = {name: content for name, content in good.items() if name.endswith(".txt")}
    first = next(name for name in good if name.startswith("log/rgb/"))
    cases = {
        "bomb": (_zip(good | {"log/zeros.txt": b"\0" * 5_000_000}), "more than"),
        "png-bomb": (_zip(good | {first: _png_of(60_000, 60_000)}), "60000x60000"),
        "slip": (_zip(good | {"../../evil.txt": b"x"}), "evil"),
        "absolute": (_zip(good | {"/evil.txt": b"x"}), "evil"),
        "program": (_zip(good | {"log/run.py": b"x"}), "run.py"),
        "no-log": (_zip({"a.txt": b"x"}), "rgb.txt"),
        "leads-out": (_zip(good | {"log/rgb.txt": b"0.0 ../../../etc/passwd\n"}), "leads out"),
        "cut": (_zip(good)[:-500], "zip"),
        "no-zip": (b"PK\x03\x04" + b"\xff" * 500, "zip"),
        "no-images": (_zip(lists), ""),
        "offsets": (_zip(good | {"log/scene.yaml": b"joint_offsets: [0.1]\n"}), "does not keep"),
    }
    for name, (data, told) in cases.items():
        job = _upload(open_, name, data)
        assert job["state"] == "failed", (name, job)
        assert told in str(job["detail"]), (name, job)
        assert open_.client.get(f"/v1/maps/{name}").json()["state"] == "failed"
        assert open_.client.post(f"/v1/maps/{name}/distance", json={"points": []}).status_code == 503
    assert not (tmp_path.parent / "evil.txt").exists()


def test_an_archive_that_lies_about_its_sizes_is_found_out(open_: Service, tmp_path: Path) -> None:
    data = bytearray(_zip(_recording(tmp_path) | {"log/zeros.txt": b"\0" * 5_000_000}))
    lie = struct.pack("<I", 1000)
    data = bytearray(bytes(data).replace(struct.pack("<I", 5_000_000), lie))
    assert _upload(open_, "liar", bytes(data))["state"] == "failed"


def test_an_upload_over_the_limit_is_refused_as_it_comes_and_leaves_no_map(open_: Service) -> None:
    def chunks() -> Iterator[bytes]:
        for _ in range(40):
            yield b"x" * 100_000

    headers = {"Content-Type": "application/zip"}
    response = open_.client.post("/v1/maps/huge/upload", content=chunks(), headers=headers)
    assert response.status_code == 413
    assert open_.client.get("/v1/maps/huge").status_code == 404


def test_a_client_that_vanishes_in_the_middle_of_an_upload_leaves_no_map(open_: Service) -> None:
    host, port = open_.url.removeprefix("http://").split(":")
    with socket.create_connection((host, int(port))) as line:
        line.sendall(
            b"POST /v1/maps/gone/upload HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/zip\r\n"
            b"Authorization: Bearer " + str(open_.key).encode() + b"\r\n"
            b"Content-Length: 1000000\r\n\r\nPK\x03\x04"
        )
        until(lambda: open_.client.get("/v1/maps/gone").status_code != 404)
    until(lambda: open_.client.get("/v1/maps/gone").status_code == 404)
    assert open_.client.get("/v1/maps/wall").status_code == 200


@pytest.mark.parametrize("kind", ["application/x-npy", "application/msgpack", "application/json"])
def test_mutated_bodies_are_refused_or_answered_and_never_break_the_service(open_: Service, kind: str) -> None:
    _fuzz(open_, kind, 150, seed=1)


@pytest.mark.long
@pytest.mark.parametrize("kind", ["application/x-npy", "application/msgpack", "application/json"])
def test_two_thousand_mutated_bodies_break_nothing_and_leave_no_memory_behind(open_: Service, kind: str) -> None:
    _fuzz(open_, kind, 500, seed=2)  # the first ones allocate memory that is kept for the next
    before = _resident_mib()
    _fuzz(open_, kind, 1500, seed=3)
    assert _resident_mib() - before < 8.0


def _resident_mib() -> float:
    gc.collect()
    lines = Path("/proc/self/status").read_text().splitlines()
    return next(int(line.split()[1]) / 1024 for line in lines if line.startswith("VmRSS"))


def _fuzz(service: Service, kind: str, count: int, seed: int) -> None:
    points = np.linspace(0, 1, 12).reshape(4, 3)
    body = {
        "application/x-npy": encode_npy(points),
        "application/msgpack": msgpack.packb({"points": points, "n_sigma": 2.0}, default=pack_array),
        "application/json": json.dumps({"points": points.tolist(), "n_sigma": 2.0}).encode(),
    }[kind]
    dice = random.Random(seed)
    for _ in range(count):
        data = bytearray(body)
        for _ in range(dice.randint(1, 8)):
            what, at = dice.randrange(4), dice.randrange(max(1, len(data)))
            if what == 0 and data:
                data[at % len(data)] = dice.randrange(256)
            elif what == 1:
                del data[at : at + dice.randint(1, 20)]
            elif what == 2:
                data[at:at] = dice.randbytes(dice.randint(1, 20))
            else:
                data = data[:at]
        response = service.client.post("/v1/maps/wall/distance", content=bytes(data), headers={"Content-Type": kind})
        assert response.status_code in (200, 413, 422), (bytes(data), response.text)
        if response.status_code != 200:
            assert response.headers["content-type"] == "application/problem+json"


def test_pickles_are_never_loaded(open_: Service) -> None:
    data = io.BytesIO()
    np.save(data, np.array([{"a": 1}], dtype=object), allow_pickle=True)
    response = open_.client.post(
        "/v1/maps/wall/distance", content=data.getvalue(), headers={"Content-Type": "application/x-npy"}
    )
    assert (response.status_code, response.json()["field"]) == (422, "dtype")

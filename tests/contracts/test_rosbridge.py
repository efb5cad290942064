"""rosbridge as roslib's own clients use it, each in a process of its own."""

from __future__ import annotations

import base64
import json
import shutil
import socket
import struct
import subprocess
import sys
import time
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from splatbot.geometry import pose_from_quat
from splatbot.services.topics import RESULT, map_topic
from splatbot.slam import FrameResult
from tests.browser.chromium import Chromium
from tests.contracts.conftest import Service, wall

CLIENT = Path(__file__).parent / "clients" / "roslib_client.py"
PAGE = Path(__file__).parent / "clients" / "roslib_page.js"


@pytest.mark.parametrize("transport", ["twisted", "asyncio"])
def test_roslibpy_reads_calls_serves_and_pushes_frames_that_are_mapped(transport: str, service: Service) -> None:
    pytest.importorskip("roslibpy")
    command = [sys.executable, str(CLIENT), service.ws("/rosbridge"), transport, "3"]
    done = subprocess.run(command, capture_output=True, text=True, timeout=120)
    assert done.returncode == 0, done.stderr[-3000:]
    told = json.loads(done.stdout.splitlines()[-1])
    assert told["width"] == 51 * 51
    assert told["bytes"] == told["width"] * told["step"]
    assert {"/odom", "/map/points", "/rosout"} <= set(told["topics"])
    assert told["type"] == "nav_msgs/msg/Odometry"
    assert abs(told["time"] - time.time()) < 120
    assert (told["code"], told["points"] > 10, told["sum"]) == (1, True, {"sum": 7})
    assert len(told["odometry"]) == 3
    assert np.abs([list(p.values()) for p in told["odometry"]]).max() < 0.01  # the wall did not move
    assert len(service.store.get("ros").ready.model) > 100


@pytest.fixture(scope="module")
def roslibjs(tmp_path_factory: pytest.TempPathFactory) -> str:
    """The text of roslibjs 1 from npm."""
    if shutil.which("npm") is None:
        pytest.skip("no npm in PATH")
    folder = tmp_path_factory.mktemp("npm")
    command = ["npm", "install", "--silent", "--no-audit", "--no-fund", "--ignore-scripts", "roslib@1"]
    done = subprocess.run(command, cwd=folder, capture_output=True, text=True, timeout=120)
    if done.returncode:
        pytest.skip(f"npm cannot install roslib: {done.stderr[-200:]}")
    return (folder / "node_modules/roslib/build/roslib.min.js").read_text()


@pytest.mark.long
def test_roslibjs_in_a_browser_reads_clouds_and_odometry_in_every_compression_and_plans(
    roslibjs: str, service: Service, tmp_path: Path
) -> None:
    result = FrameResult(0, 4.0, pose_from_quat((1, 2, 3), (0, 0, 0, 1)), "ok")
    with Chromium(tmp_path / "profile") as browser:
        browser.open(f"{service.url}/healthz")  # a page of the service: others may not connect
        time.sleep(1.0)
        browser.evaluate(roslibjs + "; 1")
        browser.evaluate(PAGE.read_text() + f"; start({json.dumps(service.ws('/rosbridge'))})")
        for _ in range(100):
            service.store.bus.publish(map_topic("wall", RESULT), result)
            time.sleep(0.1)
            if browser.evaluate("pending()") == 0:
                break
        told = browser.evaluate("told")
    assert {key for key in told if key.startswith("points")} == {f"points {c}" for c in ("none", "png", "cbor")}
    for key in ("points none", "points png", "points cbor"):
        assert told[key] == {"width": 2601, "bytes": 2601 * 48}
    for key in ("odom none", "odom png", "odom cbor"):
        assert told[key] == {"x": 1, "y": 2, "z": 3, "qz": 1}
    assert told["plan"] == 1
    assert "no service" in told["error"]


def test_a_client_that_vanishes_or_does_not_read_delays_nobody(service: Service) -> None:
    sleepy = _raw_websocket(service.ws("/rosbridge"))
    _raw_send(sleepy, {"op": "subscribe", "topic": "/map/points", "queue_length": 2})
    gone = _raw_websocket(service.ws("/rosbridge"))
    _raw_send(gone, {"op": "subscribe", "topic": "/map/points"})
    gone.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0))
    gone.close()  # a reset, as of a cable that is pulled
    with connect(service.ws("/rosbridge"), max_size=None) as good:
        good.send(json.dumps({"op": "subscribe", "topic": "/map/points", "compression": "cbor-raw"}))
        good.recv(timeout=20)
        for version in range(2, 202):  # 33 MB in JSON, more than sockets buffer
            service.store.publish("wall", wall(version))
            good.recv(timeout=20)
        assert service.client.get("/healthz").status_code == 200
    sleepy.close()


def test_a_message_beyond_the_limit_closes_that_connection_alone(service: Service) -> None:
    with connect(service.ws("/rosbridge")) as other, connect(service.ws("/rosbridge")) as greedy:
        greedy.send(json.dumps({"op": "publish", "topic": "/a", "msg": {"data": "x" * 3_000_000}}))
        with pytest.raises(ConnectionClosed):
            greedy.recv(timeout=20)
        other.send(json.dumps({"op": "call_service", "id": "a", "service": "/rosapi/nodes"}))
        assert json.loads(other.recv(timeout=20))["result"] is True


def test_damaged_bytes_on_the_socket_close_it_and_nothing_else(service: Service) -> None:
    rng = np.random.default_rng(1)
    for _ in range(50):
        raw = _raw_websocket(service.ws("/rosbridge"))
        raw.sendall(rng.integers(0, 256, 200, dtype=np.uint8).tobytes())
        raw.close()
    with connect(service.ws("/rosbridge")) as client:
        client.send(rng.integers(0, 256, 200, dtype=np.uint8).tobytes())
        assert "binary" in json.loads(client.recv(timeout=20))["msg"]
    assert service.client.get("/healthz").status_code == 200


def test_rosbridge_answers_at_the_root_too(service: Service) -> None:
    with connect(service.ws("/")) as client:
        client.send(json.dumps({"op": "call_service", "id": "a", "service": "/rosapi/get_ros_version"}))
        assert json.loads(client.recv(timeout=20))["values"]["version"] == 2


def _raw_websocket(url: str) -> socket.socket:
    """Open a connection that the test itself reads."""
    host, port = url.removeprefix("ws://").split("/")[0].split(":")
    raw = socket.create_connection((host, int(port)), timeout=20)
    raw.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    key = base64.b64encode(bytes(16)).decode()
    lines = [
        f"GET /rosbridge HTTP/1.1\r\nHost: {host}:{port}\r\nUpgrade: websocket\r\nConnection: Upgrade",
        f"Sec-WebSocket-Key: {key}\r\nSec-WebSocket-Version: 13\r\n\r\n",
    ]
    raw.sendall("\r\n".join(lines).encode())
    assert b"101" in raw.recv(1024)
    return raw


def _raw_send(raw: socket.socket, operation: dict[str, Any]) -> None:
    data = json.dumps(operation).encode()
    assert len(data) < 126
    raw.sendall(bytes([0x81, 0x80 | len(data), 0, 0, 0, 0]) + data)

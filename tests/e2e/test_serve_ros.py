"""`splatbot serve --camera replay:...`: a camera with faults is mapped, published to ROS clients and recorded."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest
from websockets.sync.client import connect

from splatbot.logs import open_log
from splatbot.logs.record import record
from tests.e2e.test_serve_cli import serving

LOG = "synthetic:tabletop?frames=12&width=160&height=120"


@pytest.mark.long
def test_a_camera_that_is_unplugged_leaves_its_map_odometry_and_a_recording_that_is_a_log(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATBOT_CAMERA_WAIT_S", "0")
    scene = open_log(LOG)
    record(scene, tmp_path / "log", ground_truth=scene.ground_truth)
    original = list(open_log(tmp_path / "log"))
    last = sorted((tmp_path / "log" / "rgb").iterdir())[8]
    image = last.read_bytes()
    last.unlink()
    os.mkfifo(last)  # the camera waits for this image until the client has subscribed
    camera = f"replay:{tmp_path / 'log'}?speed=0.1&unplug=9"
    options = "--record", str(tmp_path / "all.mcap"), "--ros-port", "0", "--viewer-port", "0"
    with serving("--camera", camera, *options) as (process, client):
        url = f"ws://127.0.0.1:{client.base_url.port}/rosbridge"
        with connect(url, max_size=None) as socket:
            socket.send(json.dumps({"op": "subscribe", "topic": "/odom"}))
            socket.send(json.dumps({"op": "call_service", "id": "after", "service": "/rosapi/topics"}))
            while json.loads(socket.recv(timeout=60)).get("id") != "after":
                pass
            last.write_bytes(image)
            told = json.loads(socket.recv(timeout=60))
            assert told["msg"]["header"]["frame_id"] == "map"
        deadline = time.monotonic() + 60
        while (described := client.get("/v1/maps/default").json())["state"] == "mapping":
            assert time.monotonic() < deadline
            time.sleep(0.1)
        assert (described["state"], described["detail"]) == ("failed", "is gone.")
        assert described["gaussians"] > 500
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0
    recorded = open_log(tmp_path / "all.mcap")
    assert len(recorded) == 9
    for a, b in zip(original, recorded, strict=False):
        np.testing.assert_array_equal(a.rgb, b.rgb)
        np.testing.assert_array_equal(a.depth, b.depth)

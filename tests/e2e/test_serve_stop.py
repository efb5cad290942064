"""`splatbot serve` stops soon after SIGTERM, although clients wait for answers."""

from __future__ import annotations

import signal
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

import pytest
from websockets.exceptions import ConnectionClosed
from websockets.sync.client import connect

from splatbot.service_key import key_file, read_key
from tests.contracts.conftest import wall
from tests.e2e.test_serve_cli import serving

MOST_S = 5.0
# The arm goes round the wall, so the planner improves its path until the budget of 10 s is used up.
AROUND_THE_WALL = {
    "start": [1.0, 0.3, 0.0, -1.5, 0.0, 1.9, 0.8],
    "goal": [-1.0, 0.3, 0.0, -1.5, 0.0, 1.9, 0.8],
    "base": {"translation": [-0.8, -0.4, 1.0], "quaternion_wxyz": [0.70710678, -0.70710678, 0.0, 0.0]},
    "budget_ms": 10_000.0,
}


@pytest.mark.long
def test_sigterm_ends_a_running_plan_and_an_open_websocket_within_5_s(tmp_path: Path) -> None:
    wall().model.save(tmp_path / "map.ply")
    with serving("--map", str(tmp_path)) as (process, client), ThreadPoolExecutor(1) as pool:
        port, key = client.base_url.port, read_key(key_file())
        with connect(f"ws://127.0.0.1:{port}/rosbridge?api_key={key}") as socket:
            plan = pool.submit(client.post, "/v1/maps/default/plans", json=AROUND_THE_WALL)
            time.sleep(2.0)  # of the search
            assert not plan.done()
            process.send_signal(signal.SIGTERM)
            assert process.wait(MOST_S) == 0
            with pytest.raises(ConnectionClosed):
                socket.recv(timeout=10)
        answer = plan.result(10)
        assert answer.status_code == 200, answer.text
        assert answer.json()["certified"]

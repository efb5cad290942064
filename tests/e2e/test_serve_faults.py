"""The service is ended, killed and started again while it maps and answers queries."""

from __future__ import annotations

import signal
import threading
from pathlib import Path

import httpx
import pytest

from splatbot.gaussians import GaussianModel
from tests.e2e.test_serve_cli import serving
from tests.waiting import until

LOG = "synthetic:tabletop?frames=300&width=160&height=120"


def _until_mapped(client: httpx.Client, versions: int) -> int:
    def version() -> int:
        return int(client.get("/v1/maps/desk").json()["map_version"])

    until(lambda: version() >= versions, 120)
    return version()


def _asking(url: str, stop: threading.Event, seen: list[int]) -> None:
    with httpx.Client(base_url=url, timeout=10) as client:
        while not stop.is_set():
            try:
                seen.append(client.post("/v1/maps/desk/distance", json={"points": [[0, 0, 1]] * 50}).status_code)
            except httpx.HTTPError:
                return


@pytest.mark.long
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_a_restart_serves_the_last_saved_map_whatever_ended_the_service(
    tmp_path: Path, number: signal.Signals, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("SPLATBOT_SAVE_EVERY_S", "0.2")
    stop, seen = threading.Event(), list[int]()
    with serving("--data", str(tmp_path / "maps")) as (process, client):
        assert client.post("/v1/maps", json={"id": "desk", "log": LOG}).status_code == 202
        before = _until_mapped(client, 3)
        asker = threading.Thread(target=_asking, args=(str(client.base_url), stop, seen))
        asker.start()
        until((tmp_path / "maps" / "desk" / "current").is_file)
        until(lambda: len(seen) > 2)  # questions and savings
        process.send_signal(number)
        code = process.wait(30)
        stop.set()
        asker.join(20)
    assert code == (0 if number is signal.SIGTERM else -signal.SIGKILL)
    assert seen
    assert set(seen) <= {200, 503}
    name = (tmp_path / "maps" / "desk" / "current").read_text()
    assert len(GaussianModel.load(tmp_path / "maps" / "desk" / name / "map.ply")) > 0
    with serving("--data", str(tmp_path / "maps")) as (_, client):
        described = client.get("/v1/maps/desk").json()
        assert described["state"] == "ended"
        assert described["map_version"] >= (before if number is signal.SIGTERM else 1)
        assert client.post("/v1/maps/desk/distance", json={"points": [[0, 0, 1]]}).status_code == 200
        assert [p.name for p in (tmp_path / "maps" / "desk").iterdir() if p.name.endswith(".tmp")] == []


@pytest.mark.long
def test_sigterm_ends_event_streams_and_jobs_within_the_time_allowed(tmp_path: Path) -> None:
    with serving("--data", str(tmp_path / "maps")) as (process, client):
        job = client.post("/v1/maps", json={"id": "desk", "log": LOG}).json()["id"]
        with client.stream("GET", f"/v1/jobs/{job}/events") as events:
            lines = events.iter_lines()
            assert next(lines)
            process.send_signal(signal.SIGTERM)
            for _ in lines:
                pass
        assert process.wait(20) == 0
    assert (tmp_path / "maps" / "desk" / "current").is_file(), "what was mapped is saved"

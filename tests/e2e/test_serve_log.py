"""`splatbot serve --log`: the map grows under the questions, and stays when the log breaks."""

from __future__ import annotations

import time
from pathlib import Path
from typing import Any

import httpx
import pytest

from splatbot.logs import open_log
from splatbot.logs.record import record
from tests.e2e.test_serve_cli import serving


def _until_not_mapping(client: httpx.Client) -> tuple[list[int], dict[str, Any]]:
    """Return the map versions during mapping, and the description of the map afterwards."""
    versions: list[int] = []
    deadline = time.monotonic() + 120
    while time.monotonic() < deadline:
        described = client.get("/v1/maps/default").json()
        if described["map_version"] not in versions[-1:]:
            versions.append(described["map_version"])
        if described["state"] != "mapping":
            return versions, described
        time.sleep(0.02)
    raise AssertionError(f"still mapping: {described}")


@pytest.mark.long
def test_versions_grow_while_a_log_is_mapped_and_the_map_is_served_after_its_end() -> None:
    with serving("--log", "synthetic:tabletop?frames=16&width=320&height=240") as (_, client):
        versions, described = _until_not_mapping(client)
        assert described["state"] == "ended"
        assert versions == sorted(versions)
        assert versions[-1] > 0
        assert described["gaussians"] > 1000
        low, high = (described["bounds"][end] for end in ("low", "high"))
        answer = client.post("/v1/maps/default/distance", json={"points": [low, high, [0, 0, 0.2]]}).json()
        assert answer["map_version"] == versions[-1]
        assert answer["inside"][2] is False, "the air before the first camera is free"
        assert client.get("/v1/maps/default/render").headers["content-type"] == "image/png"


@pytest.mark.long
def test_a_damaged_log_is_reported_and_the_map_is_served(tmp_path: Path) -> None:
    log = record(open_log("synthetic:tabletop?frames=6&width=320&height=240"), tmp_path / "log")
    broken = sorted((log / "rgb").iterdir())[4]
    broken.write_bytes(broken.read_bytes()[:200])
    with serving("--log", str(log)) as (_, client):
        _, described = _until_not_mapping(client)
        assert described["state"] == "failed"
        assert described["detail"]
        assert str(tmp_path) not in str(described)
        assert described["gaussians"] > 1000
        assert client.get("/readyz").status_code == 200

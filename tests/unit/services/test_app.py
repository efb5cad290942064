"""Errors and limits of the application, requested in process."""

from __future__ import annotations

import asyncio
from collections.abc import AsyncIterator
from typing import Any

import httpx
import pytest

from splatbot.errors import FormatError, NativeError
from splatbot.services.app import create_app
from splatbot.services.runtime import Runtime
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore


def _ask(method: str, path: str, *, error: Exception | None = None, **request: Any) -> httpx.Response:
    """Send one request to an application with small limits, whose route /boom raises ``error``."""
    store = MapStore()
    store.add("growing", source="a log", state="mapping")
    app = create_app(Runtime(ServiceSettings(max_body_bytes=1024), store))

    def boom() -> None:
        assert error is not None
        raise error

    app.add_api_route("/boom", boom)

    async def ask() -> httpx.Response:
        transport = httpx.ASGITransport(app, raise_app_exceptions=False)
        async with httpx.AsyncClient(transport=transport, base_url="http://localhost") as client:
            return await client.request(method, path, **request)

    return asyncio.run(ask())


def _problem(response: httpx.Response) -> dict[str, Any]:
    assert response.headers["content-type"] == "application/problem+json"
    body: dict[str, Any] = response.json()
    assert body["status"] == response.status_code
    assert {"type", "title", "detail"} <= set(body)
    return body


def test_an_error_of_the_tree_tells_field_and_fix_and_only_the_name_of_a_file() -> None:
    error = FormatError("is cut off.", file="/srv/secret/map.ply", field="vertex", hint="write it again")
    response = _ask("GET", "/boom", error=error)
    body = _problem(response)
    assert response.status_code == 422
    assert body["type"] == "urn:splatbot:problem:format"
    assert (body["file"], body["field"], body["hint"]) == ("map.ply", "vertex", "write it again")
    assert "secret" not in response.text


def test_an_unexpected_error_tells_the_client_nothing_of_itself() -> None:
    response = _ask("GET", "/boom", error=RuntimeError("password=hunter2 in /srv/secret"))
    assert _problem(response)["status"] == 500
    assert "hunter2" not in response.text
    assert "secret" not in response.text


def test_an_error_that_passes_by_itself_says_when_to_try_again() -> None:
    response = _ask("GET", "/boom", error=NativeError("is being rebuilt."))
    assert _problem(response)["status"] == 503
    assert response.headers["retry-after"] == "1"


def test_a_map_without_a_state_is_listed_and_not_ready() -> None:
    (listed,) = _ask("GET", "/v1/maps").json()["maps"]
    assert (listed["id"], listed["map_version"], listed["gaussians"], listed["bounds"]) == ("growing", 0, 0, None)
    assert _problem(_ask("GET", "/readyz"))["status"] == 503
    assert _ask("GET", "/healthz").status_code == 200
    body = _problem(_ask("POST", "/v1/maps/growing/distance", json={"points": [[0, 0, 0]]}))
    assert (body["status"], body["type"]) == (503, "urn:splatbot:problem:map-not-ready")
    assert _problem(_ask("GET", "/v1/maps/growing/render"))["status"] == 503


@pytest.mark.parametrize("told", [True, False])
def test_a_body_over_the_limit_is_refused_whether_or_not_it_tells_its_length(told: bool) -> None:
    async def chunks() -> AsyncIterator[bytes]:
        for _ in range(8):
            yield b" " * 256

    body = b" " * 2048 if told else chunks()
    headers = {"content-type": "application/json"}
    response = _ask("POST", "/v1/maps/growing/distance", content=body, headers=headers)
    assert _problem(response)["status"] == 413
    assert "1024 bytes" in response.text


def test_every_route_shows_an_example_and_its_problems_in_the_api_description() -> None:
    description = _ask("GET", "/openapi.json").json()
    operations = [(p, m, op) for p, item in description["paths"].items() for m, op in item.items() if p != "/boom"]
    assert len(operations) >= 25
    for path, method, operation in operations:
        where = f"{method} {path}"
        body = operation.get("requestBody", {}).get("content", {})
        if "application/json" in body:
            assert body["application/json"]["examples"], where
        done = next(answer for status, answer in operation["responses"].items() if status.startswith("2"))
        for media, content in done.get("content", {}).items():
            assert media != "application/json" or content["example"], where
        assert all("example" in p or "examples" in p.get("schema", p) for p in operation.get("parameters", [])), where
        if "{map_id}" in path and not path.endswith("/upload"):  # which makes the map
            assert "application/problem+json" in operation["responses"]["404"]["content"], where

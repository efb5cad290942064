"""Dependencies of routes: settings, the store, and the map that the URL names."""

from __future__ import annotations

import hashlib
import secrets
from typing import Annotated, Any

from fastapi import Depends, Header, Path, Request, Response
from starlette.concurrency import run_in_threadpool

from splatbot.services.problems import MEDIA_TYPE
from splatbot.services.runtime import Runtime
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore, ServedMap

# Version 3 of a map in this process is not version 3 in the next: tags of different processes must differ.
_PROCESS = secrets.token_hex(4)


# Dependencies are coroutines: FastAPI runs functions in the threads of the work, behind which a request would wait.
async def _runtime(request: Request) -> Runtime:
    runtime: Runtime = request.app.state.runtime
    return runtime


async def _store(request: Request) -> MapStore:
    return (await _runtime(request)).store


async def _settings(request: Request) -> ServiceSettings:
    return (await _runtime(request)).settings


async def _caller(request: Request) -> str:
    caller: str = request.state.client
    return caller


async def _served_map(
    request: Request,
    store: Annotated[MapStore, Depends(_store)],
    map_id: Annotated[str, Path(description="as GET /v1/maps lists it", examples=["default"])],
) -> ServedMap:
    served = store.get(map_id)
    request.state.map_version = served.map_version  # problem documents name it too
    return served


async def _map_after_frames(
    request: Request,
    store: Annotated[MapStore, Depends(_store)],
    map_id: Annotated[str, Path(description="as GET /v1/maps lists it", examples=["default"])],
) -> ServedMap:
    await run_in_threadpool(store.frames_first.wait)
    return await _served_map(request, store, map_id)


Service = Annotated[Runtime, Depends(_runtime)]
Store = Annotated[MapStore, Depends(_store)]
Settings = Annotated[ServiceSettings, Depends(_settings)]
Caller = Annotated[str, Depends(_caller)]
"""Name of the client, whose quota new maps, versions and jobs count in."""
Served = Annotated[ServedMap, Depends(_served_map)]
ServedAfterFrames = Annotated[ServedMap, Depends(_map_after_frames)]
"""The same for expensive requests: frames that are being mapped have priority."""


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """Return OpenAPI entries of the problem documents that a route may answer with."""
    what = {
        403: "the key lacks the scope, or the client's quota of maps or bytes is used up",
        404: "nothing of that name",
        409: "conflicts with the present state: the name is taken, the arm moves, the key was used",
        413: "more than one request may ask",
        415: "the body is of a kind that is not taken",
        422: "the request makes no sense; `detail` names the field and `hint` the fix",
        429: "too many requests, or jobs of this client; try again after Retry-After seconds",
        507: "the disk is full",
        503: "not ready; try again after Retry-After seconds",
    }
    example = {"type": "urn:splatbot:problem:input", "title": "...", "status": 0, "detail": "...", "hint": "..."}
    return {
        status: {"description": what[status], "content": {MEDIA_TYPE: {"example": example | {"status": status}}}}
        for status in statuses
    }


def example(body: dict[str, Any]) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI entry of a JSON answer with an example."""
    return {200: {"content": {"application/json": {"example": body}}}}


def etag(served: ServedMap, what: str = "") -> str:
    """Return the entity tag of a representation of one map version."""
    key = f"{_PROCESS} {served.id} {served.generation} {served.map_version} {served.state} {what}"
    return f'"{hashlib.sha256(key.encode()).hexdigest()[:20]}"'


def version_headers(served: ServedMap, tag: str) -> dict[str, str]:
    """Return the headers of an answer that a client may cache until the map changes."""
    return {"X-Map-Version": str(served.map_version), "ETag": tag, "Cache-Control": "no-cache"}


def unchanged(request: Request, served: ServedMap, tag: str) -> Response | None:
    """Return a response with status 304 if the client's cached copy is current, else None."""
    if tag in request.headers.get("if-none-match", ""):
        return Response(status_code=304, headers=version_headers(served, tag))
    return None


async def idempotency_key(
    key: Annotated[
        str | None,
        Header(
            alias="Idempotency-Key",
            max_length=200,
            description="a repeated request with the same key returns the same job",
            examples=["0f2c"],
        ),
    ] = None,
) -> str | None:
    """Return the request's Idempotency-Key."""
    return key


IdempotencyKey = Annotated[str | None, Depends(idempotency_key)]

"""What routes ask of the application: settings, the store, and the map that the URL names."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import Depends, Path, Request

from splatbot.services.problems import MEDIA_TYPE
from splatbot.services.settings import ServiceSettings
from splatbot.services.store import MapStore, ServedMap


def _store(request: Request) -> MapStore:
    store: MapStore = request.app.state.store
    return store


def _settings(request: Request) -> ServiceSettings:
    settings: ServiceSettings = request.app.state.settings
    return settings


def _served_map(
    request: Request,
    store: Annotated[MapStore, Depends(_store)],
    map_id: Annotated[str, Path(description="as GET /v1/maps lists it", examples=["default"])],
) -> ServedMap:
    served = store.get(map_id)
    request.state.map_version = served.map_version  # problem documents name it too
    return served


Store = Annotated[MapStore, Depends(_store)]
Settings = Annotated[ServiceSettings, Depends(_settings)]
Served = Annotated[ServedMap, Depends(_served_map)]


def problems(*statuses: int) -> dict[int | str, dict[str, Any]]:
    """OpenAPI entries of the problem documents that a route may answer with."""
    what = {
        404: "no map of that name",
        413: "more than one request may ask",
        422: "the request makes no sense; `detail` names the field and `hint` the fix",
        503: "not ready; try again after Retry-After seconds",
    }
    example = {"type": "urn:splatbot:problem:input", "title": "...", "status": 0, "detail": "...", "hint": "..."}
    return {
        status: {"description": what[status], "content": {MEDIA_TYPE: {"example": example | {"status": status}}}}
        for status in statuses
    }


def example(body: dict[str, Any]) -> dict[int | str, dict[str, Any]]:
    """The OpenAPI entry of a JSON answer with an example."""
    return {200: {"content": {"application/json": {"example": body}}}}

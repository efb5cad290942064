"""Versions of maps: saved, listed, restored, deleted."""

from __future__ import annotations

from dataclasses import asdict
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Response

from splatbot.services.codecs import JSON, body_of, request_body
from splatbot.services.dependencies import Caller, Served, Service, example, problems
from splatbot.services.store import ServedMap
from splatbot.services.version_index import Version
from splatbot.services.version_schemas import VersionInfo, VersionList, VersionNumber, VersionRequest
from splatbot.services.versions import Versions

router = APIRouter(prefix="/v1/maps", tags=["versions"])

_EXAMPLE: dict[str, Any] = {
    "number": 3,
    "map_version": 12,
    "created": 1785000000.0,
    "label": "clean table",
    "note": None,
    "gaussians": 48213,
    "keyframes": 31,
    "bytes": 61201408,
    "checksum": "9b0f" * 16,
    "parent": 2,
    "restored_from": None,
    "in_use": True,
    "restorable": True,
}
_REQUESTS = {"with a label": {"label": "clean table", "note": "before the shift"}, "without": {}}
_SAVED: dict[int | str, dict[str, Any]] = {
    201: {
        "description": "the version; `Location` names it",
        "model": VersionInfo,
        "content": {JSON: {"example": _EXAMPLE}},
    }
}
_Number = Annotated[VersionNumber, Path(description="as GET .../versions lists it", examples=[1])]


@router.post(
    "/{map_id}/versions",
    status_code=201,
    responses=_SAVED | problems(403, 404, 409, 415, 422, 503, 507),
    openapi_extra=request_body(VersionRequest, _REQUESTS),
)
def save_version(
    served: Served, service: Service, query: Annotated[VersionRequest, Depends(body_of(VersionRequest))], caller: Caller
) -> Response:
    """Save the map as it is now. A map that grows waits with its next frame meanwhile.

    Beyond `max_versions` of a map the oldest version without a label makes room, but never the one in use.
    """
    version = service.history.save(served, owner=caller, label=query.label, note=query.note)
    place = {"Location": f"/v1/maps/{served.id}/versions/{version.number}"}
    body = _info(service.history.versions, service.store.get(served.id), version).model_dump_json()
    return Response(body, 201, place, media_type="application/json")


@router.get(
    "/{map_id}/versions",
    responses=example({"map_version": 12, "versions": [_EXAMPLE]}) | problems(404, 409),
)
def list_versions(served: Served, service: Service) -> VersionList:
    """List the versions of a map by number."""
    versions = service.history.versions
    rows = [_info(versions, served, version) for version in versions.of_map(served.id)]
    return VersionList(map_version=served.map_version, versions=rows)


@router.get("/{map_id}/versions/{number}", responses=example(_EXAMPLE) | problems(404, 409))
def get_version(served: Served, service: Service, number: _Number) -> VersionInfo:
    """Describe a version."""
    versions = service.history.versions
    return _info(versions, served, versions.get(served.id, number))


@router.post(
    "/{map_id}/versions/{number}/restore",
    responses=example(_EXAMPLE | {"number": 4, "parent": 3, "restored_from": 3}) | problems(403, 404, 409, 503, 507),
)
def restore_version(served: Served, service: Service, number: _Number, caller: Caller) -> VersionInfo:
    """Let the map go back to a version: all answers come from it, with a new `map_version`.

    The answer is the new version that records it. The state before becomes a version first, unless it is one. A map
    that grows goes on from the version. Its next frame may be anywhere in it; frames that are not found are lost.
    """
    version = service.history.restore(served, number, owner=caller)
    return _info(service.history.versions, service.store.get(served.id), version)


@router.delete("/{map_id}/versions/{number}", status_code=204, responses=problems(404, 409, 507))
def delete_version(served: Served, service: Service, number: _Number) -> Response:
    """Delete a version, unless the map answers from it or a request works on it (409)."""
    service.history.delete(served, number)
    return Response(status_code=204)


def _info(versions: Versions, served: ServedMap, version: Version) -> VersionInfo:
    shown = {name: value for name, value in asdict(version).items() if name in VersionInfo.model_fields}
    return VersionInfo(**shown, in_use=versions.in_use(served) == version, restorable=version.world == served.world)

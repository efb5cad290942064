"""Merges and comparisons of maps and versions."""

from __future__ import annotations

from functools import partial
from typing import Annotated

from fastapi import APIRouter, Depends, Response

from splatbot.errors import InputError
from splatbot.services.codecs import body_of, request_body
from splatbot.services.dependencies import Caller, IdempotencyKey, Served, Service, problems
from splatbot.services.library import check_id
from splatbot.services.merging import compare_maps, find_states, merge_maps
from splatbot.services.routes.jobs import accepted, starts
from splatbot.services.version_schemas import DiffRequest, MergeRequest

router = APIRouter(prefix="/v1/maps", tags=["versions"])

_MERGE = {"two maps": {"id": "both", "other": "tuesday"}}
_DIFF = {
    "another map": {"other": "tuesday"},
    "an earlier version of this map": {"version": 1, "other": "monday"},
}


@router.post(
    "/{map_id}/merge",
    status_code=202,
    responses=starts("a job makes the merged map; its result has the pose of the other map in this one")
    | problems(403, 404, 409, 413, 415, 422, 429, 503),
    openapi_extra=request_body(MergeRequest, _MERGE),
)
def merge(
    served: Served,
    service: Service,
    query: Annotated[MergeRequest, Depends(body_of(MergeRequest))],
    key: IdempotencyKey,
    caller: Caller,
) -> Response:
    """Merge another, later map into the world of this one, as a new map with the name `id`; both stay as they are.

    The other map is located by features and depth of its keyframes, which must show the same places. If it is not
    found, the job fails and there is no new map.
    """
    check_id(query.id)
    request = f"merge {served.id} {query.model_dump_json()}"
    known = service.jobs.known(key, request)
    if known is not None:
        return accepted(known)
    a, b = find_states(service, served, query.version, query.other, query.other_version)
    if a.world == b.world:
        raise InputError("is the same map.", field="other", hint="compare its versions, or restore one")
    service.quotas.check_bytes(caller)
    made = service.store.add(
        query.id,
        source=f"{a.served.id} and {b.served.id}",
        state="mapping",
        workspace=a.served.workspace,
        awaited=False,
        owner=caller,
    )
    try:
        work = merge_maps(service, made, a, b)
        gone = partial(service.withdraw, made)
        return accepted(service.make(made, work, kind="merge", key=key, request=request, abandoned=gone))
    except BaseException:  # the queue is full: undo the creation
        service.withdraw(made)
        raise


@router.post(
    "/{map_id}/diff",
    status_code=202,
    responses=starts("a job compares them; its result lists the objects that appeared, moved or were removed")
    | problems(404, 409, 413, 415, 422, 429, 503),
    openapi_extra=request_body(DiffRequest, _DIFF),
)
def diff(
    served: Served,
    service: Service,
    query: Annotated[DiffRequest, Depends(body_of(DiffRequest))],
    key: IdempotencyKey,
    caller: Caller,
) -> Response:
    """Find the objects that differ between this map and a later one, or between versions of this map.

    Each object has `kind`, `center_m`, `previous_center_m` if it moved, `size_m`, `axes` and `color`, in metres in the
    world of this map. `T_a_b` is the pose of the other map. The maps do not change; a map that grows is read between
    two frames.
    """
    request = f"diff {served.id} {query.model_dump_json()}"
    known = service.jobs.known(key, request)
    if known is not None:
        return accepted(known)
    a, b = find_states(service, served, query.version, query.other, query.other_version)
    work = compare_maps(service, a, b, aligned=query.aligned)
    job, _ = service.jobs.submit("diff", work, key=key, request=request, client=caller)
    return accepted(job)

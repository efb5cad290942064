"""Arms, their leases, and the emergency stop."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Request, Response

from splatbot.services.codecs import body_of, request_body
from splatbot.services.dependencies import Service, example, problems
from splatbot.services.leases import Lease
from splatbot.services.schemas import LeaseInfo, LeaseRequest, StopInfo

router = APIRouter(prefix="/v1", tags=["motion"])

_LEASE = {"lease": "5b8e", "arm": "fake", "seconds": 10.0}
_TAKEN: dict[int | str, dict[str, Any]] = {201: {"content": {"application/json": {"example": _LEASE}}}}
_STOP = {"stopped": True, "by": "127.0.0.1", "since": 1.7e9}
_Name = Annotated[str, Path(description="as GET /v1/arms lists it", examples=["fake"])]
_LeaseId = Annotated[str, Path(max_length=64, description="as POST /v1/arms/ARM/lease named it", examples=["5b8e"])]

_ARM = {"name": "fake", "robot": "panda", "busy": False, "state": "idle", "position": [0.0] * 7, "leased": False}


@router.get("/arms", responses=example({"arms": [{"name": "fake"}]}))
def list_arms(service: Service) -> dict[str, Any]:
    """List the arms that can follow plans: "fake" follows exactly, "twin" is simulated."""
    return {"arms": [{"name": name} for name in service.arms.names]}


@router.get("/arms/{name}", responses=example(_ARM) | problems(422))
def get_arm(service: Service, name: _Name) -> dict[str, Any]:
    """Return the joint positions of an arm; plans for it start there."""
    arm = service.arms.get(name)
    at = arm.feedback
    state = at.state.value if at is not None else "idle"
    position = at.position.tolist() if at is not None else arm.robot.home.tolist()
    leased = service.arms.leases.of(name) is not None
    return {
        "name": name,
        "robot": arm.robot.name,
        "busy": arm.busy,
        "state": state,
        "position": position,
        "leased": leased,
    }


@router.post(
    "/arms/{name}/lease",
    status_code=201,
    responses=_TAKEN | problems(409, 415, 422),
    openapi_extra=request_body(LeaseRequest, {"ten seconds": {"seconds": 10.0}}),
)
def take_lease(
    service: Service,
    request: Request,
    name: _Name,
    query: Annotated[LeaseRequest, Depends(body_of(LeaseRequest))],
) -> LeaseInfo:
    """Take the lease of an arm, which motions of the arm need. The arm stops when its lease ends."""
    admin = "admin" in request.state.scopes
    lease = service.arms.lease(name, request.state.client, seconds=query.seconds, preempt=query.preempt, admin=admin)
    return _info(lease)


@router.put("/leases/{lease_id}", responses=example(_LEASE) | problems(409))
def renew_lease(service: Service, lease_id: _LeaseId) -> LeaseInfo:
    """Extend a lease by its time."""
    return _info(service.arms.leases.renew(lease_id))


@router.delete("/leases/{lease_id}", status_code=204)
def release_lease(service: Service, lease_id: _LeaseId) -> Response:
    """End a lease; an arm that moves on it stops."""
    service.arms.leases.release(lease_id)
    return Response(status_code=204)


@router.get("/stop", responses=example(_STOP))
async def get_stop(service: Service) -> StopInfo:
    """Return the emergency stop in force."""
    return _stop_info(service)


@router.post("/stop", responses=example(_STOP))
async def emergency_stop(service: Service, request: Request) -> StopInfo:
    """Stop every arm within one control period and refuse motions until DELETE /v1/stop. Any key may send this."""
    service.arms.stop_all(request.state.client)
    return _stop_info(service)


@router.delete("/stop", responses=example(_STOP | {"stopped": False, "by": None, "since": None}))
async def reset_stop(service: Service) -> StopInfo:
    """End the emergency stop; motions that it stopped do not go on."""
    service.arms.reset()
    return _stop_info(service)


def _info(lease: Lease) -> LeaseInfo:
    return LeaseInfo(lease=lease.id, arm=lease.arm, seconds=lease.seconds or 0.0)


def _stop_info(service: Service) -> StopInfo:
    stop = service.arms.emergency_stop
    return StopInfo(stopped=False) if stop is None else StopInfo(stopped=True, by=stop.by, since=stop.since)

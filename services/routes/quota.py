"""The quota of the caller."""

from __future__ import annotations

from fastapi import APIRouter
from pydantic import BaseModel, Field

from splatbot.services.dependencies import Caller, Service, example

router = APIRouter(prefix="/v1/quota", tags=["maps"])

_EXAMPLE = {
    "client": "sha256:0f2c9a4b1d3e",
    "requests_per_s": 500.0,
    "maps": {"used": 2, "most": 128},
    "jobs": {"used": 0, "most": 16},
    "bytes": {"used": 6171264, "most": 17179869184},
}


class Share(BaseModel):
    """Used and largest number."""

    used: int = Field(description="present number")
    most: int = Field(description="largest number")


class QuotaInfo(BaseModel):
    """Quota of the caller."""

    client: str = Field(description="begin of the hash of its key, or its address")
    requests_per_s: float = Field(description="requests per second in the long run; more are answered 429")
    maps: Share = Field(description="maps that it made; more are answered 403")
    jobs: Share = Field(description="jobs that wait or run; more are answered 429")
    bytes: Share = Field(description="Gaussians of its maps, and its versions on disk; more are answered 403")


@router.get("", responses=example(_EXAMPLE))
def get_quota(service: Service, caller: Caller) -> QuotaInfo:
    """Show the quota of the caller's key, or of its address if it has no key."""
    limits, quotas = service.settings, service.quotas
    return QuotaInfo(
        client=caller,
        requests_per_s=limits.requests_per_s,
        maps=Share(used=quotas.maps_of(caller), most=limits.max_client_maps),
        jobs=Share(used=quotas.jobs_of(caller), most=limits.max_client_jobs),
        bytes=Share(used=quotas.bytes_of(caller), most=limits.max_client_bytes),
    )

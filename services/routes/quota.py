"""The quota of the caller."""

from __future__ import annotations

from fastapi import APIRouter

from splatbot.services.dependencies import Caller, Service, example
from splatbot.services.schemas import QuotaInfo, Share

router = APIRouter(prefix="/v1/quota", tags=["maps"])

_EXAMPLE = {
    "client": "sha256:0f2c9a4b1d3e",
    "requests_per_s": 500.0,
    "maps": {"used": 2, "most": 128},
    "jobs": {"used": 0, "most": 16},
    "bytes": {"used": 6171264, "most": 17179869184},
}


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

"""Jobs: work that outlasts a request."""

from __future__ import annotations

from collections.abc import AsyncIterator
from dataclasses import asdict
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent

from splatbot.services.codecs import JSON
from splatbot.services.dependencies import Service, example, problems
from splatbot.services.jobs import ENDED, Job
from splatbot.services.schemas import JobInfo, JobList
from splatbot.services.topics import job_topic

router = APIRouter(prefix="/v1/jobs", tags=["jobs"])

JOB: dict[str, Any] = {
    "id": "5f0c2a9b1d3e4f60",
    "kind": "map",
    "state": "running",
    "progress": 0.4,
    "detail": "frame 48 of 120",
    "result": None,
    "created": 1785000000.0,
    "started": 1785000000.1,
    "ended": None,
}
JobId = Annotated[str, Path(description="as the 202 answer named it", examples=["5f0c2a9b1d3e4f60"])]


async def _job(service: Service, job_id: JobId) -> Job:
    """Find the job before a stream begins: afterwards the status 404 can no longer be sent."""
    return service.jobs.get(job_id)


def info(job: Job) -> JobInfo:
    """Describe a job to clients."""
    return JobInfo(**asdict(job))


def accepted(job: Job, *, under: str = "/v1/jobs") -> Response:
    """Return status 202 with the job's URL."""
    headers = {"Location": f"{under}/{job.id}", "Retry-After": "1"}
    return Response(info(job).model_dump_json(), 202, headers, media_type="application/json")


def starts(what: str) -> dict[int | str, dict[str, Any]]:
    """Return the OpenAPI entry of an answer that names a job."""
    return {202: {"description": f"{what}; `Location` names it", "model": JobInfo, "content": {JSON: {"example": JOB}}}}


@router.get("", responses=example({"jobs": [JOB]}))
def list_jobs(service: Service) -> JobList:
    """List all jobs, oldest first; of the ended ones, the latest 200."""
    return JobList(jobs=[info(job) for job in service.jobs.list()])


@router.get("/{job_id}", responses=example(JOB) | problems(404))
def get_job(service: Service, job_id: JobId) -> JobInfo:
    """Return the state of a job."""
    return info(service.jobs.get(job_id))


@router.delete("/{job_id}", responses=example(JOB | {"state": "cancelled"}) | problems(404))
def cancel_job(service: Service, job_id: JobId) -> JobInfo:
    """Cancel a job: one that waits ends now, one that runs soon; one that has ended stays as it is."""
    return info(service.jobs.cancel(job_id))


@router.get("/{job_id}/events", response_class=EventSourceResponse, responses=problems(404, 503))
async def job_events(service: Service, watched: Annotated[Job, Depends(_job)]) -> AsyncIterator[ServerSentEvent]:
    """Stream the job at each change as server-sent events named by its state, up to the end."""
    with service.bus.subscribe(job_topic(watched.id), capacity=64) as changes:
        async for message in changes:
            job: Job = message.value
            yield ServerSentEvent(data=info(job).model_dump(), event=job.state, id=str(message.number))
            if job.state in ENDED:
                return

"""Arms that follow planned motions."""

from __future__ import annotations

from collections.abc import AsyncIterator
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Path, Response
from fastapi.sse import EventSourceResponse, ServerSentEvent

from splatbot.protocols import Feedback
from splatbot.services.codecs import body_of, plain, request_body
from splatbot.services.dependencies import IdempotencyKey, Service, example, problems
from splatbot.services.jobs import ENDED, Job
from splatbot.services.routes.jobs import JOB, accepted, info, starts
from splatbot.services.schemas import JobInfo, TrajectoryRequest
from splatbot.services.topics import job_topic, motion_topic

router = APIRouter(prefix="/v1", tags=["motion"])

_EXAMPLE = {"plan": "0d6c1b7f2a3e4f50", "arm": "fake", "lease": "5b8e"}
_JOB = JOB | {"kind": "trajectory", "detail": None}
_MotionId = Annotated[str, Path(description="as the 202 answer named it", examples=["5f0c2a9b1d3e4f60"])]


async def _motion(service: Service, job_id: _MotionId) -> Job:
    return service.arms.motions.get(job_id)


@router.post(
    "/trajectories",
    status_code=202,
    responses=starts("the arm moves") | problems(404, 409, 415, 422, 503),
    openapi_extra=request_body(
        TrajectoryRequest, {"a plan": {"plan": "0d6c1b7f2a3e4f50", "arm": "fake", "lease": "5b8e"}}
    ),
)
def send_trajectory(
    service: Service,
    query: Annotated[TrajectoryRequest, Depends(body_of(TrajectoryRequest))],
    key: IdempotencyKey,
) -> Response:
    """Let an arm follow a plan that begins where the arm is.

    The curve is certified again at this moment, and while the arm moves whenever the map changes. 409: it is refused,
    with the reason; the arm moves already, stands elsewhere, or belongs to another client.
    """
    motion = service.plans.get(query.plan).motion
    job = service.arms.send(query.arm, motion, lease=query.lease, key=key, content=query.model_dump_json())
    return accepted(job, under="/v1/trajectories")


@router.get("/trajectories/{job_id}", responses=example(_JOB) | problems(404))
def get_trajectory(service: Service, job_id: _MotionId) -> JobInfo:
    """Return the state of a motion: "succeeded" at its end, "failed" after a fault, "cancelled" after a stop."""
    return info(service.arms.motions.get(job_id))


@router.delete("/trajectories/{job_id}", responses=example(_JOB | {"state": "cancelled"}) | problems(404))
def stop_trajectory(service: Service, job_id: _MotionId) -> JobInfo:
    """Stop the arm, within one period of its controller."""
    return info(service.arms.motions.cancel(job_id))


@router.get("/trajectories/{job_id}/events", response_class=EventSourceResponse, responses=problems(404, 503))
async def trajectory_events(
    service: Service, watched: Annotated[Job, Depends(_motion)]
) -> AsyncIterator[ServerSentEvent]:
    """Stream the arm's feedback while it moves, then the final state, as server-sent events."""
    with service.bus.subscribe(job_topic(watched.id), motion_topic(watched.id), capacity=64) as news:
        async for message in news:
            value: Job | Feedback = message.value
            if isinstance(value, Feedback):
                yield ServerSentEvent(data=_feedback(value), event="feedback")
            elif value.state in ENDED:
                yield ServerSentEvent(data=info(value).model_dump(), event=value.state)
                return


def _feedback(feedback: Feedback) -> Any:
    return plain(
        {
            "time": feedback.time,
            "state": feedback.state.value,
            "position": feedback.position,
            "velocity": feedback.velocity,
            "desired": feedback.desired,
            "error": feedback.error,
        }
    )

"""Picks of objects in the twin."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Response

from splatbot.errors import InputError
from splatbot.grasping.language import LanguageAffordance
from splatbot.grasping.options import GraspOptions
from splatbot.grasping.pick_types import PickOptions, PickStage, PickStep
from splatbot.services.codecs import body_of, plain, request_body
from splatbot.services.dependencies import Caller, IdempotencyKey, Service, problems
from splatbot.services.jobs import JobCancelled, JobHandle
from splatbot.services.problems import TooLargeError
from splatbot.services.routes.jobs import accepted, starts
from splatbot.services.schemas import PicksRequest
from splatbot.sim.scene import Scene, load_scene, scene_names

router = APIRouter(prefix="/v1/picks", tags=["grasping"])

_EXAMPLES = {
    "by its name": {"scene": "tabletop_clutter", "target": "can"},
    "by words, carried home": {"scene": "tabletop_clutter", "target": "largest box", "force": 40.0, "home": True},
}
_STAGES = list(PickStage)


@router.post(
    "",
    status_code=202,
    responses=starts("a job picks it; its result holds the outcome, each stage, and the lift of each object")
    | problems(404, 409, 413, 415, 422, 429, 503),
    openapi_extra=request_body(PicksRequest, _EXAMPLES),
)
def pick(
    service: Service,
    query: Annotated[PicksRequest, Depends(body_of(PicksRequest))],
    key: IdempotencyKey,
    caller: Caller,
) -> Response:
    """Pick an object in the physics of a scene: scan it, find grasps, plan, approach, close, lift, check.

    The whole way is certified before the arm moves. A pick that ends otherwise than "picked" is a result, not a failure
    of the job; cancelling stops the arm. `progress` grows by the stages: grasp, plan, open, move, look, adjust,
    approach, close, lift, check and, with `home`, carry. A further attempt begins again at plan.
    """
    if query.scene not in scene_names():
        raise InputError(f"is {query.scene[:80]!r}.", field="scene", hint=f"scenes: {', '.join(scene_names())}")
    if query.budget_ms > service.settings.max_plan_ms:
        hint = "give less, or raise SPLATBOT_MAX_PLAN_MS"
        raise TooLargeError(f"is more than {service.settings.max_plan_ms:g}.", field="budget_ms", hint=hint)
    options = PickOptions(
        lift=query.lift,
        force=query.force,
        tries=query.tries,
        attempts=query.attempts,
        budget_ms=query.budget_ms,
        grasp=GraspOptions(seed=query.seed),
        seed=query.seed,
    )
    scene = load_scene(query.scene)
    job, _ = service.jobs.submit(
        "pick",
        lambda handle: _pick(scene, query, options, handle),
        key=key,
        request=query.model_dump_json(),
        client=caller,
    )
    return accepted(job)


def _pick(scene: Scene, query: PicksRequest, options: PickOptions, handle: JobHandle) -> dict[str, Any]:
    from splatbot.sim.picking import pick_in_twin
    from splatbot.sim.twin import Twin

    def on_step(step: PickStep) -> None:
        handle.report((_STAGES.index(step.stage) + 1) / (len(_STAGES) + 1), f"{step.stage}: {step.note}")

    handle.report(0.0, f"scanning {scene.name}")
    picked = pick_in_twin(
        Twin(scene),
        query.target,
        [LanguageAffordance()],
        options,
        views=query.views,
        margin=query.margin,
        home=query.home,
        look=query.look,
        seed=query.seed,
        stop=handle.cancelled.is_set,
        on_step=on_step,
    )
    if handle.cancelled.is_set():
        raise JobCancelled
    result: dict[str, Any] = plain({"scene": scene.name} | picked.summary())
    return result

"""Trials of motions in the twin."""

from __future__ import annotations

from contextlib import AbstractContextManager, nullcontext
from typing import Annotated, Any

from fastapi import APIRouter, Depends, Response

from splatbot.errors import InputError
from splatbot.planning import JointTrajectory
from splatbot.robots.robot import RobotModel
from splatbot.services.codecs import body_of, plain, request_body
from splatbot.services.dependencies import Caller, IdempotencyKey, Service, problems
from splatbot.services.jobs import JobHandle
from splatbot.services.robots_in_maps import base_in, robot_in
from splatbot.services.routes.jobs import accepted, starts
from splatbot.services.schemas import BASE_EXAMPLE, TrialsRequest
from splatbot.services.twins_of_maps import scene_of_map
from splatbot.sim.motion import motion_from_trajectory
from splatbot.sim.scene import Scene, load_scene, scene_names

router = APIRouter(prefix="/v1/sim", tags=["simulation"])


@router.post(
    "/trials",
    status_code=202,
    responses=starts("a job runs the trials; its result holds one entry for each") | problems(404, 415, 422, 429, 503),
    openapi_extra=request_body(
        TrialsRequest,
        {
            "three displaced scenes": {"scene": "tabletop_clutter", "trials": 3},
            "a plan in a map": {"map": "default", "plan": "0123456789abcdef", "base": BASE_EXAMPLE},
        },
    ),
)
def trials(
    service: Service,
    query: Annotated[TrialsRequest, Depends(body_of(TrialsRequest))],
    key: IdempotencyKey,
    caller: Caller,
) -> Response:
    """Try a motion in a scene's physics: tracking error, contacts, dropped objects.

    Trial i has the seed `seed` + i, which displaces movable objects by millimetres. In a map, which has no moves of its
    own, a plan is followed; `notes` of a result describe the physics model of the map.
    """
    plan = service.plans.get(query.plan) if query.plan is not None else None
    robot = None
    if query.map is None:
        scene = _shipped(query.scene or "empty")
        place: AbstractContextManager[Scene] = nullcontext(scene.with_effects(force=query.force, forbid=query.forbid))
    elif query.scene is not None:
        raise InputError("is given in addition to a map.", field="scene", hint="give one of the two")
    elif plan is None:
        raise InputError("is missing.", field="plan", hint="a map has no moves of its own: plan one in it")
    else:
        served = service.store.get(query.map)
        robot = robot_in(served, plan.robot)
        _ = served.ready  # a map without a state is refused at once, not by the job
        place = scene_of_map(served, base_in(served, query.base), plan.robot, force=query.force, forbid=query.forbid)

    def work(handle: JobHandle) -> dict[str, Any]:
        with place as scene:
            trajectory = plan.trajectory if plan is not None else None
            done = [_trial(scene, robot, trajectory, query, i, handle) for i in range(query.trials)]
        return {"scene": query.scene or ("empty" if query.map is None else None), "map": query.map, "trials": done}

    job, _ = service.jobs.submit("trials", work, key=key, request=query.model_dump_json(), client=caller)
    return accepted(job)


def _shipped(name: str) -> Scene:
    if name not in scene_names():
        raise InputError(f"is {name[:80]!r}.", field="scene", hint=f"scenes: {', '.join(scene_names())}")
    return load_scene(name)


def _trial(
    scene: Scene,
    robot: RobotModel | None,
    trajectory: JointTrajectory | None,
    query: TrialsRequest,
    number: int,
    handle: JobHandle,
) -> dict[str, Any]:
    from splatbot.sim.twin import Twin

    twin = Twin(scene, robot=robot, seed=query.seed + number)
    motion = motion_from_trajectory(trajectory) if trajectory is not None else None

    def progress(share: float) -> None:
        handle.report((number + share) / query.trials, f"trial {number + 1} of {query.trials}")

    result = twin.follow(motion, progress=progress).to_dict()
    del result["decisions"]
    body: dict[str, Any] = plain({"seed": twin.seed} | result)
    return body

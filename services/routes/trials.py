"""Trials of motions in the twin."""

from __future__ import annotations

from typing import Annotated, Any

from fastapi import APIRouter, Depends, Response

from splatbot.errors import InputError
from splatbot.planning import Trajectory
from splatbot.services.codecs import body_of, plain, takes
from splatbot.services.dependencies import IdempotencyKey, Service, problems
from splatbot.services.jobs import JobHandle
from splatbot.services.routes.jobs import accepted, starts
from splatbot.services.schemas import TrialsRequest
from splatbot.sim.motion import motion_from_trajectory
from splatbot.sim.scene import Scene, load_scene, scene_names

router = APIRouter(prefix="/v1/sim", tags=["simulation"])


@router.post(
    "/trials",
    status_code=202,
    responses=starts("a job runs the trials; its result holds one entry for each") | problems(404, 415, 422, 503),
    openapi_extra=takes(TrialsRequest, {"three displaced scenes": {"scene": "tabletop_clutter", "trials": 3}}),
)
def trials(
    service: Service, asked: Annotated[TrialsRequest, Depends(body_of(TrialsRequest))], key: IdempotencyKey
) -> Response:
    """Try a motion in a scene's physics: how well the arm follows, what it touches, what falls.

    Trial i has the seed `seed` + i, which displaces movable objects by millimetres.
    """
    if asked.scene not in scene_names():
        raise InputError(f"is {asked.scene[:80]!r}.", field="scene", hint=f"scenes: {', '.join(scene_names())}")
    scene = load_scene(asked.scene).with_effects(force=asked.force, forbid=asked.forbid)
    trajectory = service.plans.get(asked.plan).trajectory if asked.plan is not None else None

    def work(handle: JobHandle) -> dict[str, Any]:
        return {
            "scene": asked.scene,
            "trials": [_trial(scene, trajectory, asked, i, handle) for i in range(asked.trials)],
        }

    return accepted(service.jobs.submit("trials", work, key=key, request=asked.model_dump_json())[0])


def _trial(
    scene: Scene, trajectory: Trajectory | None, asked: TrialsRequest, number: int, handle: JobHandle
) -> dict[str, Any]:
    from splatbot.sim.twin import Twin

    twin = Twin(scene, seed=asked.seed + number)
    motion = motion_from_trajectory(trajectory) if trajectory is not None else None

    def progress(share: float) -> None:
        handle.tell((number + share) / asked.trials, f"trial {number + 1} of {asked.trials}")

    result = twin.follow(motion, progress=progress).to_dict()
    del result["decisions"]
    told: dict[str, Any] = plain({"seed": twin.seed} | result)
    return told

"""The robot in live frames: its joint states, and the object in its hand."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Path, Response
from pydantic import BaseModel, Field

from splatbot.errors import InputError
from splatbot.services.arms import known_robot
from splatbot.services.codecs import body_of, request_body
from splatbot.services.dependencies import Served, Service, example, problems
from splatbot.services.robot_mask import MAX_HELD
from splatbot.services.schemas import MAX_JOINTS, Vector4
from splatbot.services.schemas import Request as Body
from splatbot.services.topics import JointState

router = APIRouter(tags=["robots"])

_MAX_STATES = 1000  # of a request


class JointStateIn(Body):
    """Joints of a robot at a time."""

    stamp: float = Field(allow_inf_nan=False, description="[s], by the clock of the images")
    position: list[float] = Field(min_length=1, max_length=MAX_JOINTS, description="[rad or m]")
    names: list[str] = Field([], max_length=MAX_JOINTS, description="of the joints; if empty, in the robot's order")


class JointStatesRequest(Body):
    """Joint states of a robot; send them at 10 Hz or more, while frames are pushed."""

    states: list[JointStateIn] = Field(min_length=1, max_length=_MAX_STATES, description="in any order")


class JointStatesTaken(BaseModel):
    """Use of reported joint states."""

    masks: int = Field(description="masks of maps that use them; 0: the robot is masked in no map")


class HeldRequest(Body):
    """Object in the robot's hand, as spheres in the frame of the last link."""

    spheres: list[Vector4] = Field(max_length=MAX_HELD, description="x, y, z, radius [m]; if empty, it is released")


class NoRobotError(InputError):
    """No robot is masked in the frames of a map."""

    http_status = 409


_STATES = {"states": [{"stamp": 0.02, "position": [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.8]}]}
_HELD = {"spheres": [[0.0, 0.0, 0.12, 0.04]]}


@router.post(
    "/v1/robots/{robot}/joints",
    responses=example({"masks": 1}) | problems(413, 415, 422),
    openapi_extra=request_body(JointStatesRequest, {"one state": _STATES}),
)
def report_joints(
    robot: Annotated[str, Path(description="as `splatbot robot list` names it", examples=["panda"])],
    service: Service,
    query: Annotated[JointStatesRequest, Depends(body_of(JointStatesRequest))],
) -> JointStatesTaken:
    """Report a robot's joint states, by which it is masked in frames without joints of their own."""
    name, kept = known_robot(robot).name, 0
    for state in sorted(query.states, key=lambda given: given.stamp):
        if state.names and len(state.names) != len(state.position):
            hint = "give one position for each name"
            raise InputError(f"has {len(state.position)} values.", field="position", hint=hint)
        kept = service.report_joints(name, JointState(state.stamp, tuple(state.names), np.array(state.position)))
    return JointStatesTaken(masks=kept)


@router.put(
    "/v1/maps/{map_id}/held",
    status_code=204,
    response_class=Response,
    responses=problems(404, 409, 413, 415, 422),
    openapi_extra=request_body(HeldRequest, {"an object of 8 cm": _HELD}),
)
def hold_object(served: Served, query: Annotated[HeldRequest, Depends(body_of(HeldRequest))]) -> Response:
    """Mask an object in the robot's hand too, from the next frame on."""
    if served.mask is None:
        hint = "create the map with robot"
        raise NoRobotError(f"no robot is masked in map {served.id!r}.", field="robot", hint=hint)
    served.mask.hold(query.spheres)
    return Response(status_code=204)

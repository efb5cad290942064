"""Supports and objects in the map."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Query, Request, Response

from splatbot.errors import InputError
from splatbot.grasping.object_list import list_objects, list_planes, stroke_of
from splatbot.services.arms import known_robot
from splatbot.services.codecs import answer, answers
from splatbot.services.dependencies import Served, problems
from splatbot.services.robots_in_maps import base_in, objects_in

router = APIRouter(prefix="/v1/maps", tags=["grasping"])

_ANSWER = {
    "map_version": 12,
    "hand_opens_m": 0.08,
    "planes": [{"label": "support", "height_base_m": 0.002, "size_m": [0.8, 0.6], "gaussians": 9000}],
    "objects": [
        {
            "number": 0,
            "label": "red box",
            "target": "object 0",
            "size_m": [0.11, 0.06, 0.08],
            "center_world_m": [0.1, 0.2, 0.8],
            "center_base_m": [0.5, 0.0, 0.04],
            "gaussians": 540,
            "on_support": True,
            "graspable_by_size": True,
            "verdict": "fits",
            "obstacle": None,
        }
    ],
}


def _robot(
    robot: Annotated[str, Query(description="robot whose hand must enclose an object", examples=["panda"])] = "panda",
) -> str:
    return robot


@router.get("/{map_id}/objects", response_class=Response, responses=answers(_ANSWER) | problems(404, 422, 503))
def objects(request: Request, served: Served, robot: Annotated[str, Depends(_robot)]) -> Response:
    """List the supports and objects of a map that has a robot base; `target` names an object in POST .../grasps."""
    arm = known_robot(robot)
    if arm.gripper is None:
        raise InputError("has no hand.", field="robot", hint="name a robot with a gripper, as panda")
    scene = objects_in(served, np.asarray(base_in(served, None)), as_known=True).scene
    body = {
        "map_version": served.map_version,
        "hand_opens_m": stroke_of(arm),
        "planes": list_planes(scene),
        "objects": [item.to_dict() for item in list_objects(scene, arm)],
    }
    return answer(request, body)

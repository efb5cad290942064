"""Supports and objects in the map."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from fastapi import APIRouter, Depends, Query, Request, Response

from splatbot.errors import InputError
from splatbot.grasping.object_list import ListedObject, list_planes, stroke_of
from splatbot.services.codecs import answer, answers
from splatbot.services.dependencies import Served, problems
from splatbot.services.margins import margin_source
from splatbot.services.robots_in_maps import base_in, objects_in, robot_in

router = APIRouter(prefix="/v1/maps", tags=["grasping"])

_ANSWER = {
    "map_version": 12,
    "hand_opens_m": 0.08,
    "arm_margin_m": 0.006,
    "margin_source": "audited error of the map around the objects",
    "planes": [
        {
            "label": "support",
            "normal_base": [0.0, 0.0, 1.0],
            "height_base_m": 0.002,
            "size_m": [0.8, 0.6],
            "gaussians": 9000,
        }
    ],
    "objects": [
        {
            "number": 0,
            "kind": "object",
            "label": "red box",
            "target": "object 0",
            "size_m": [0.11, 0.06, 0.08],
            "center_world_m": [0.1, 0.2, 0.8],
            "center_base_m": [0.5, 0.0, 0.04],
            "gaussians": 540,
            "on_support": True,
            "graspable_by_size": True,
            "reach": "yes",
            "verdict": "fits",
            "obstacle": None,
        },
        {
            "number": 1,
            "kind": "object",
            "label": "grey box 1",
            "target": "object 1",
            "size_m": [0.09, 0.04, 0.07],
            "center_world_m": [0.4, 0.2, 0.9],
            "center_base_m": [0.6, -0.3, 0.04],
            "gaussians": 410,
            "on_support": True,
            "graspable_by_size": True,
            "reach": "blocked",
            "verdict": "blocked",
            "obstacle": "no posture found that places the tool at its centre is free: link 4 is 8.0 mm deep in the map",
        },
    ],
}


def _robot(
    robot: Annotated[str, Query(description="robot whose hand must enclose an object", examples=["panda"])] = "panda",
) -> str:
    return robot


@router.get("/{map_id}/objects", response_class=Response, responses=answers(_ANSWER) | problems(404, 422, 503))
def objects(request: Request, served: Served, robot: Annotated[str, Depends(_robot)]) -> Response:
    """List the supports and objects of a map that has a robot base; `target` names an object in POST .../grasps.

    Objects of `kind` "structure" are pieces of walls, posts or tables, with the reason as `obstacle`, and no target.
    """
    arm = robot_in(served, robot)
    if arm.gripper is None:
        raise InputError("has no hand.", field="robot", hint="name a robot with a gripper, as panda")
    found = objects_in(served, np.asarray(base_in(served, None)), as_known=True)
    source = margin_source(served, None)
    margin, why = source.margin, source.why
    if source.error is not None:
        margin, why = found.error_around(source.error), "audited error of the map around the objects"
    plane = None if served.workspace is None else served.workspace.support_plane

    def listed() -> tuple[ListedObject, ...]:
        return found.listed(arm, margin=margin, plane=plane)

    body = {
        "map_version": served.map_version,
        "hand_opens_m": stroke_of(arm),
        "arm_margin_m": margin,
        "margin_source": why,
        "planes": list_planes(found.scene),
        "objects": [item.to_dict() for item in served.derived.get(("listed objects", arm.name, margin), listed)],
    }
    return answer(request, body)

"""A twin whose robot looks like its meshes instead of its collision geometry, for videos."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np

from splatbot.report.robot_drawing import DrawnPart
from splatbot.robots.appearance import links_and_finger, merged
from splatbot.sim.world import BODY_GROUP, World, owners_of


def dressed(world: World) -> World:
    """Return a copy of a world in which the robot has visual meshes, and its collision geometry is hidden.

    Its model has the same positions, so that a view of it shows the data of the original. It is not for physics.
    """
    if world.robot is None:
        return world
    spec = world.spec.copy()
    parts, fingers = links_and_finger(world.robot)
    names = [f"link{k}" for k in range(len(world.robot) + 1)]
    for k, name in enumerate(names):
        _dress(spec, spec.body(name), [part for part in merged(parts) if part.link == k])
    for name in ("finger1", "finger2") if fingers else ():
        _dress(spec, spec.body(name), fingers)
    model = spec.compile()
    owner, of_robot = owners_of(model)
    return replace(world, spec=spec, model=model, owner=owner, of_robot=of_robot, for_views=True)


def _dress(spec: Any, body: Any, parts: Iterable[DrawnPart]) -> None:
    """Hide the geoms of a body and add meshes."""
    parts = list(parts)
    for geom in body.geoms if parts else ():
        geom.group = BODY_GROUP
    for number, part in enumerate(parts):
        corners, faces = np.unique(part.triangles.reshape(-1, 3), axis=0, return_inverse=True)
        triangles = faces.reshape(-1, 3)
        flat = (
            (triangles[:, 0] == triangles[:, 1])
            | (triangles[:, 1] == triangles[:, 2])
            | (triangles[:, 2] == triangles[:, 0])
        )
        name = f"{body.name}-{number}"
        mesh = spec.add_mesh(name=name, uservert=corners.ravel(), userface=triangles[~flat].ravel())
        mesh.inertia = mujoco.mjtMeshInertia.mjMESH_INERTIA_SHELL
        body.add_geom(
            type=mujoco.mjtGeom.mjGEOM_MESH, meshname=name, contype=0, conaffinity=0, mass=0, rgba=[*part.color, 1.0]
        )

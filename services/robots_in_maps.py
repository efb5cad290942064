"""Pose of the robot in a served map, its collision spheres, and the objects around it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import RobotSpheres
from splatbot.errors import InputError
from splatbot.robots.graspable_objects import GraspableObjects, measured_map, segment_objects
from splatbot.robots.joint_offsets import robot_in_scene
from splatbot.robots.joints import suspect_degrees
from splatbot.robots.robot import RobotModel
from splatbot.services.arms import known_robot
from splatbot.services.schemas import Pose
from splatbot.services.store import ServedMap


def base_in(served: ServedMap, given: Pose | None) -> NDArray[np.float64]:
    """Return T_world_base (4, 4): that of the request, else that of the map.

    Raises:
        InputError: neither.
    """
    if given is not None:
        return given.matrix("base")
    known = served.workspace.T_world_base if served.workspace is not None else None
    if known is None:
        hint = "give base (T_world_base), or put a scene.yaml next to the map"
        raise InputError(f"is not known for map {served.id!r}.", field="base", hint=hint)
    return known


def is_base_proposed(served: ServedMap, given: Pose | None) -> bool:
    """Return whether :func:`base_in` is the proposal of `splatbot info --fit-plane`, and not that of a real robot."""
    return given is None and served.workspace is not None and served.workspace.base_proposed


def robot_in(served: ServedMap, robot: str) -> RobotModel:
    """Return a robot by name, with the joint offsets of the scene of a map.

    Raises:
        InputError: the name is unknown, or the offsets are not those of this robot.
    """
    return robot_in_scene(known_robot(robot), served.workspace)


def arm_in(
    served: ServedMap, robot: str, base: Pose | None, margin: float, opening: float | None = None
) -> tuple[RobotModel, RobotSpheres]:
    """Return a robot and its spheres at its base in the map."""
    model = robot_in(served, robot)
    return model, RobotSpheres(model, T_world_base=base_in(served, base), margin=margin, opening=opening)


def objects_in(served: ServedMap, base: NDArray[np.float64], *, as_known: bool) -> GraspableObjects:
    """Return the objects on the table of a map, computed once for each version and base.

    Args:
        served: the map.
        base: T_world_base (4, 4).
        as_known: the base is the map's own, and so are its box and plane.
    """
    measured = served.derived.get("measured", lambda: measured_map(served.ready, served.run))
    return served.derived.get(
        ("objects", base.tobytes(), as_known),
        lambda: segment_objects(measured, base, served.workspace, as_known=as_known),
    )


def joints_of(model: RobotModel, values: list[float], field: str) -> NDArray[np.float64]:
    """Return joint values (J,).

    Raises:
        InputError: another number of joints, or one that is not finite.
    """
    q = np.array(values, dtype=np.float64)
    if q.shape != (len(model),) or not np.isfinite(q).all():
        hint = f"{model.name} has {len(model)} joints"
        raise InputError(f"has {len(values)} values.", field=field, hint=hint)
    suspect_degrees(q, model.chain, field)
    return q

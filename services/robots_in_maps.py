"""Where the robot stands in a served map, what it is for collision checks, and the things around it."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import RobotSpheres
from splatbot.errors import InputError
from splatbot.robots.graspable_objects import GraspableObjects, measured_map, things_of
from splatbot.robots.robot import RobotModel
from splatbot.services.arms import known_robot
from splatbot.services.schemas import Pose
from splatbot.services.store import ServedMap


def base_in(served: ServedMap, asked: Pose | None) -> NDArray[np.float64]:
    """T_world_base (4, 4): as asked, else as the map knows it.

    Raises:
        InputError: neither.
    """
    if asked is not None:
        return asked.matrix("base")
    known = served.workspace.T_world_base if served.workspace is not None else None
    if known is None:
        hint = "give base (T_world_base), or keep a scene.yaml beside the map"
        raise InputError(f"is not known for map {served.id!r}.", field="base", hint=hint)
    return known


def arm_in(
    served: ServedMap, robot: str, base: Pose | None, margin: float, opening: float | None = None
) -> tuple[RobotModel, RobotSpheres]:
    """A robot and its spheres where it stands in the map."""
    model = known_robot(robot)
    return model, RobotSpheres(model, T_world_base=base_in(served, base), margin=margin, opening=opening)


def things_in(served: ServedMap, base: NDArray[np.float64], *, as_known: bool) -> GraspableObjects:
    """The things on the table of a map, worked out once for each of its states and bases.

    Args:
        served: the map.
        base: T_world_base (4, 4).
        as_known: the base is the map's own, and so are its box and plane.
    """
    measured = served.derived.get("measured", lambda: measured_map(served.ready, served.run))
    return served.derived.get(
        ("things", base.tobytes(), as_known),
        lambda: things_of(measured, base, served.workspace, as_known=as_known),
    )


def joints_of(model: RobotModel, values: list[float], field: str) -> NDArray[np.float64]:
    """Joint values (J,).

    Raises:
        InputError: another number of joints, or one that is not finite.
    """
    q = np.array(values, dtype=np.float64)
    if q.shape != (len(model),) or not np.isfinite(q).all():
        hint = f"{model.name} has {len(model)} joints"
        raise InputError(f"has {len(values)} values.", field=field, hint=hint)
    return q

"""Unknown space of served maps as obstacles of a plan."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.collision.unknown import UnknownPolicy
from splatbot.errors import InputError
from splatbot.results.unknown import unknown_in_reach, with_unknown
from splatbot.robots.in_view import reopen_log
from splatbot.robots.robot import RobotModel
from splatbot.services.store import ServedMap


def field_with_unknown(
    served: ServedMap,
    policy: UnknownPolicy,
    robot: RobotModel,
    T_world_base: NDArray[np.float64],
    start: NDArray[np.float64],
) -> Callable[[float], GaussianCollisionField]:
    """Return a function of the margin [m] that gives the field of a map with its unknown space under a policy.

    The search for unknown space takes seconds, once for each map version and robot.

    Args:
        served: the map.
        policy: treatment of unknown space.
        robot: the arm.
        T_world_base: (4, 4) pose of the map's base. Bases of requests would make each request a search.
        start: (J,) configuration at which the arm is [rad or m]; the space that it fills is no obstacle.

    Raises:
        InputError: the policy needs a recording, and the map has none.
    """
    field = served.field
    if policy == "free":
        return lambda margin: field
    run = served.run
    if run is None:
        raise InputError(
            f"needs depth images, and map {served.id!r} has no recording.",
            field="unknown",
            hint='give "free", or map a recording',
        )
    arm = RobotSpheres(robot, T_world_base=T_world_base)
    space = served.derived.get(("unknown space", robot.name), lambda: unknown_in_reach(run, reopen_log(run), arm))
    return with_unknown(field, served.ready.model, space, policy, arm, start)

"""Obstacles of plans in served maps in addition to the map: support plane, measured surface and unknown space."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import RobotSpheres
from splatbot.collision.unknown import UnknownPolicy
from splatbot.errors import InputError, SplatbotError
from splatbot.results.measured import MeasuredSurface
from splatbot.results.plan_obstacles import PlanObstacles
from splatbot.results.unknown import unknown_in_reach
from splatbot.robots.in_view import reopen_log
from splatbot.robots.robot import RobotModel
from splatbot.services.margins import MarginSource
from splatbot.services.schemas import Pose
from splatbot.services.store import ServedMap


def plan_obstacles(
    served: ServedMap,
    robot: RobotModel,
    T_world_base: NDArray[np.float64],
    start: NDArray[np.float64],
    *,
    policy: UnknownPolicy = "free",
    support: bool = True,
    margin: MarginSource | None = None,
) -> PlanObstacles:
    """Return the obstacles of a plan: the map, its support plane, measured surface, and unknown space under a policy.

    The search for unknown space takes seconds, once for each map version and robot. That for measured surface takes
    seconds too, once for each part of the map that an arm reaches. :func:`check_unknown` comes first.

    Args:
        served: the map.
        robot: the arm.
        T_world_base: (4, 4) pose of its base. With unknown space it is the map's, as others would each be a search.
        start: (J,) configuration at which the arm is [rad or m]; the space that it fills is no obstacle.
        policy: treatment of unknown space.
        support: whether the support plane of the map's scene.yaml is an obstacle.
        margin: of the plan. An audited one makes surface an obstacle that the recording measured and the map lacks. If
            the recording can no longer be read and "auto" was not requested, there is no such obstacle.

    Raises:
        SplatbotError: the margin "auto" was requested, and the recording cannot be read.
    """
    arm = RobotSpheres(robot, T_world_base=T_world_base)
    known = served.workspace.support_plane if served.workspace is not None and support else None
    run, space, surface = served.run, None, None
    if policy != "free":
        assert run is not None  # by check_unknown
        space = served.derived.get(("unknown space", robot.name), lambda: unknown_in_reach(run, reopen_log(run), arm))
    if margin is not None and margin.audited:
        assert run is not None  # by margin_source
        try:
            surface = served.derived.get(
                "measured surface",
                lambda: MeasuredSurface(run, lambda: reopen_log(run), served.ready.model, served.field),
            ).near(arm)
        except SplatbotError:
            if margin.required:
                raise
    return PlanObstacles(
        served.field,
        served.ready.model,
        arm,
        start,
        plane=known,
        measured=surface,
        space=space,
        policy=policy,
    )


def check_unknown(served: ServedMap, policy: UnknownPolicy, given: Pose | None) -> None:
    """Check, before any work, that unknown space can be found for a request.

    Args:
        served: the map.
        policy: treatment of unknown space.
        given: base of the request. If None, it is that of the map.

    Raises:
        InputError: the map has no recording, or the request gives a base, which would make each one a search.
    """
    if policy == "free":
        return
    if served.run is None:
        raise InputError(
            f"needs depth images, and map {served.id!r} has no recording.",
            field="unknown",
            hint='give "free", or map a recording',
        )
    if given is not None:
        hint = "write the base into the scene.yaml of the map, or leave unknown space free"
        raise InputError("is given, but unknown space is known for the base of the map.", field="base", hint=hint)

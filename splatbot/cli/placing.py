"""Options of commands that place a robot in a map: poses, base and margin."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import ArrayLike, NDArray

    from splatbot.collision import GaussianCollisionField, RobotSpheres
    from splatbot.collision.unknown import UnknownPolicy
    from splatbot.gaussians import GaussianModel
    from splatbot.grasping.sampler import GraspSampler
    from splatbot.results.folder import RunFolder
    from splatbot.results.plan_obstacles import PlanObstacles
    from splatbot.robots.robot import RobotModel

Pose = tuple[float, float, float, float, float, float, float]

PROPOSED_BASE = "only proposed: measure where the robot stands; info --fit-plane --base-offset X Y Z moves it"
"""Words for a base that no robot confirms, see :func:`is_base_proposed`."""
_FARTHEST = 100.0  # [m]
_LARGEST_MARGIN = 1.0  # [m]


def checked_pose(pose: Pose, flag: str) -> NDArray[np.float64]:
    """Return the pose (4, 4) of a position and a quaternion wxyz.

    Raises:
        InputError: the quaternion is no rotation, or the position is farther than 100 m, as in millimetres.
    """
    import numpy as np

    from splatbot.errors import InputError
    from splatbot.geometry import pose_from_quat

    if not max(map(abs, pose[:3])) <= _FARTHEST:
        where = " ".join(f"{x:g}" for x in pose[:3])
        hint = f"give metres: {' '.join(f'{x / 1e3:g}' for x in pose[:3])}"
        raise InputError(f"is at {where} m: millimetres?", field=flag, hint=hint)
    try:
        return np.asarray(pose_from_quat(pose[:3], pose[3:]))
    except ValueError as error:
        raise InputError(f"{error}.", field=flag, hint="QW QX QY QZ of no rotation are 1 0 0 0") from error


def named_robot(name: str) -> RobotModel:
    """Return a robot by name; commands call it before their libraries load, so that a wrong name fails at once.

    Raises:
        InputError: no robot has that name.
        FormatError: the file of the robot is damaged.
    """
    from splatbot.robots.store import load_robot

    return load_robot(name)


def robot_of_grasps(file: Path) -> RobotModel:
    """Return the robot of a file of grasps, before the libraries load that read the rest of it.

    Raises:
        FormatError: the file is no such file, or that of the robot is damaged.
        InputError: no robot has that name.
    """
    import json

    from splatbot.errors import FormatError

    try:
        name = str(json.loads(file.read_text())["robot"])
    except (ValueError, TypeError, KeyError) as error:
        hint = "give the grasp.json of `splatbot grasp`"
        raise FormatError(f"is no file of grasps ({error!r}).", file=file, hint=hint) from error
    return named_robot(name)


def base_pose(pose: Pose | None, map_: Path) -> NDArray[np.float64]:
    """Return T_world_base (4, 4): the given one, or that of the scene.yaml next to the map.

    Raises:
        InputError: it is not known.
    """
    from splatbot.errors import InputError
    from splatbot.workspace import find_workspace

    if pose is not None:
        return checked_pose(pose, "--base")
    known = find_workspace(map_)
    if known is None or known.T_world_base is None:
        hint = "give --base, or write a scene.yaml: splatbot info MAP --fit-plane estimates one"
        raise InputError("is not known.", file=map_, field="base", hint=hint)
    return known.T_world_base


def is_base_proposed(pose: Pose | None, map_: Path) -> bool:
    """Return whether the base is the one that `splatbot info --fit-plane` proposed, and not that of a real robot."""
    from splatbot.workspace import find_workspace

    known = find_workspace(map_)
    return pose is None and known is not None and known.base_proposed


def base_words(pose: Pose | None) -> str:
    """Return the option that gives the same base to the next command, with a space before it; empty for the default."""
    return "" if pose is None else f" --base {' '.join(str(value) for value in pose)}"


def pose_values(T: NDArray[np.float64]) -> dict[str, list[float]]:
    """Return a pose (4, 4) as JSON values: translation [m] and quaternion_wxyz."""
    from splatbot.geometry import rotation_to_quat

    return {"translation": T[:3, 3].tolist(), "quaternion_wxyz": rotation_to_quat(T[:3, :3]).tolist()}


def run_folder(map_: Path, flag: str) -> RunFolder:
    """Return the run folder that a flag requires.

    Raises:
        InputError: the map is a file.
    """
    from splatbot.errors import InputError
    from splatbot.results.folder import RunFolder

    if not map_.is_dir():
        raise InputError("needs a run folder.", field=flag, hint="give the folder that `splatbot map` wrote")
    return RunFolder(map_)


def map_obstacles(
    map_: Path,
    field: GaussianCollisionField,
    model: GaussianModel,
    arm: RobotSpheres,
    start: NDArray[np.float64],
    *,
    unknown: UnknownPolicy,
    support: bool = True,
    measured: bool = False,
) -> PlanObstacles:
    """Return the obstacles of plans in a map: its Gaussians, the plane of its scene.yaml, and others of its run.

    Args:
        map_: run folder or map file.
        field: collision field of the map.
        model: the map.
        arm: the arm.
        start: (J,) configuration at which it is [rad or m].
        unknown: treatment of unknown space, which takes seconds to find unless it is free.
        support: whether the support plane of the scene.yaml is an obstacle.
        measured: whether measured surface that the map lacks is an obstacle, which takes seconds to find once.

    Raises:
        InputError: unknown space or measured surface is wanted, and the map is in no run's folder.
        FormatError: the run or the scene.yaml is damaged.
        LogError: the log of the run is damaged.
    """
    from splatbot.results.measured import MeasuredSurface
    from splatbot.results.plan_obstacles import PlanObstacles
    from splatbot.results.unknown import unknown_in_reach
    from splatbot.robots.in_view import reopen_log
    from splatbot.workspace import find_workspace

    space, surface = None, None
    if unknown != "free":
        run = run_folder(map_, "--unknown")
        space = unknown_in_reach(run, reopen_log(run), arm)
    if measured:
        run = run_folder(map_, "--margin auto")
        surface = MeasuredSurface(run, lambda: reopen_log(run), model, field).near(arm)
    known = find_workspace(map_) if support else None
    plane = None if known is None else known.support_plane
    return PlanObstacles(field, model, arm, start, plane=plane, measured=surface, space=space, policy=unknown)


def agree_with_plans(
    sampler: GraspSampler, map_: Path, robot: RobotModel, start: ArrayLike, policy: UnknownPolicy, *, measured: bool
) -> None:
    """Limit the pre-grasps of a sampler to ends of plans from ``start`` (J,); see :func:`map_obstacles`."""
    import numpy as np

    from splatbot.collision import GaussianCollisionField, RobotSpheres
    from splatbot.gaussians import GaussianModel
    from splatbot.layouts import map_file

    model, most = GaussianModel.load(map_file(map_)), max(sampler.margin, sampler.arm_margin)
    field = GaussianCollisionField(model, min_observations=sampler.min_observations)
    spheres = RobotSpheres(robot, T_world_base=sampler.scene.T_world_base)
    here = np.asarray(start, dtype=np.float64)
    around = map_obstacles(map_, field, model, spheres, here, unknown=policy, measured=measured)
    sampler.agree_with_plans(around.field(most), around.unknown_field(most))


def joint_values(words: tuple[str, ...], robot: RobotModel, flag: str) -> NDArray[np.float64]:
    """Parse joint values (J,) [rad or m], or "home"; commands call it before their libraries load.

    Raises:
        InputError: they are no numbers, too few or too many, degrees, or beyond a limit.
    """
    import numpy as np

    from splatbot.errors import InputError
    from splatbot.robots.joints import check_limits

    if words == ("home",):
        return np.asarray(robot.home)
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(f"is {' '.join(words)}.", field=flag, hint='give numbers, or "home"') from error
    if len(values) != len(robot) or not np.isfinite(values).all():
        raise InputError(f"has {len(values)} values.", field=flag, hint=f"{robot.name} has {len(robot)} joints")
    check_limits(values, robot.chain, flag)
    return values


def margin_value(text: str) -> float:
    """Parse a margin [m].

    Raises:
        InputError: it is no number, below 0, or above 1 m, as in millimetres.
    """
    import math

    from splatbot.errors import InputError

    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 <= value < math.inf:
        raise InputError(f"is {text!r}.", field="--margin", hint='give metres, 0 or more, or "auto"')
    if value > _LARGEST_MARGIN:
        hint = f"give metres, at most {_LARGEST_MARGIN:g}: {value / 1e3:g}"
        raise InputError(f"is {value:g} m: millimetres?", field="--margin", hint=hint)
    return value

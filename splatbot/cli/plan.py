"""`splatbot plan`."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import tyro

from splatbot.cli.paths import check_file, result_folder, written_to
from splatbot.cli.placing import (
    PROPOSED_BASE,
    Pose,
    base_pose,
    base_words,
    checked_pose,
    is_base_proposed,
    joint_values,
    map_obstacles,
    margin_value,
    named_robot,
    pose_values,
    run_folder,
)
from splatbot.errors import InputError
from splatbot.layouts import map_file

if TYPE_CHECKING:
    from collections.abc import Callable

    import numpy as np
    from numpy.typing import NDArray

    from splatbot.collision import GaussianCollisionField
    from splatbot.gaussians import GaussianModel
    from splatbot.planning import GaussianRRTStar, JointTrajectory, PlanResult
    from splatbot.planning import Path as JointPath
    from splatbot.planning.closest import ClosestApproach
    from splatbot.results.plan_obstacles import PlanObstacles
    from splatbot.results.region_plan import RegionPlan
    from splatbot.robots.robot import RobotModel


def plan(
    *,
    map: Annotated[Path, tyro.conf.arg(metavar="MAP")],
    start: Annotated[tuple[str, ...], tyro.conf.arg(metavar="Q ...")],
    goal: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="Q ...")] = None,
    goal_pose: Annotated[Pose | None, tyro.conf.arg(metavar="X Y Z QW QX QY QZ")] = None,
    grasp: Annotated[Path | None, tyro.conf.arg(metavar="JSON")] = None,
    grasp_index: int = 0,
    robot: str = "panda",
    base: Annotated[Pose | None, tyro.conf.arg(metavar="X Y Z QW QX QY QZ")] = None,
    margin: Annotated[str | None, tyro.conf.arg(metavar="M|auto")] = None,
    confidence: float = 0.999,
    unknown: Literal["free", "cautious", "occupied"] = "free",
    support: bool = True,
    n_sigma: float = 2.0,
    min_observations: int = 1,
    speed: float = 0.2,
    budget_ms: float = 500.0,
    seed: int = 0,
    seen_from: Annotated[tuple[float, float, float] | None, tyro.conf.arg(metavar="X Y Z")] = None,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
    overwrite: bool = False,
) -> int:
    """Plan a path of an arm among the Gaussians of a map.

    Writes the certified trajectory (trajectory.json as ROS JointTrajectory, trajectory.csv at 1 kHz), plan.json and
    plan.png. The page plan.html animates arm and map. A start or goal in collision is drawn in refused.png.

    Examples:
        splatbot plan --map runs/latest --start home --goal 0.5 -0.3 0 -2.0 0 1.9 0.8
        splatbot plan --map runs/latest --margin auto --start home --goal-pose 0.5 0.2 0.3 0 1 0 0
        splatbot plan --map runs/latest --robot ur5e-2f85 --start home --grasp runs/grasp/grasp.json
        splatbot plan --map map.ply --base 0 0.4 0 0.7071 -0.7071 0 0 --start home --goal home

    Args:
        map: a map file, or a run folder.
        start: joint values [rad or m], or "home".
        goal: joint values, or "home".
        goal_pose: pose of the tool instead of --goal, in the frame of the robot's base: position [m] and quaternion.
        grasp: file of `splatbot grasp`; the goal is the pre-grasp. See `splatbot plan-pick` for the whole pick.
        grasp_index: rank of the grasp in that file, from 0.
        robot: its name, as of `splatbot robot list`.
        base: pose of the robot's base in the map; by default that of the scene.yaml next to the map (see
            `splatbot info --fit-plane`).
        margin: clearance [m] to the map. "auto" is the error of the map's surfaces in the region of the motion, audited
            against the depth of the run (see `splatbot audit`). It is the default in a run folder; the default of a map
            file is 0. "auto" also makes surface an obstacle that two frames measured and the map lacks.
        confidence: share of the confirmed surface that the margin "auto" covers, 0..1.
        unknown: space that no frame of the run saw to be empty is free, or "occupied". With "cautious" it is occupied
            only where two frames looked and measured no depth, as at dark, shiny or transparent objects.
        support: the support plane of the scene.yaml is an obstacle within reach, also where no frame saw it. A base
            below the plane excludes it.
        n_sigma: surface of a Gaussian, in standard deviations.
        min_observations: Gaussians that the depth of fewer keyframes supports are ignored, as in `splatbot grasp`.
        speed: fraction of the limits of velocity and acceleration, as MoveIt's scaling factors; 1 is as fast as the
            robot can.
        budget_ms: time budget of the planner [ms].
        seed: seed of the search.
        seen_from: place of the camera of plan.png [m, base]; a map is sharp from where it was recorded. By default the
            camera stands above the side of the base.
        out: folder to write to; by default runs/plan, whose earlier results are replaced.
        overwrite: replace the results of an earlier call in the folder that --out names.
    """
    if [goal, goal_pose, grasp].count(None) != 2:
        flags = "--goal, --goal-pose, --grasp"
        raise InputError("must be given, one of them.", field=flags, hint="give joints, a pose, or a file of grasps")
    if not 0.0 < speed <= 1.0:
        raise InputError(f"is {speed:g}.", field="--speed", hint="give a fraction of the limits, above 0, at most 1")
    file = map_file(map)
    check_file(grasp, "--grasp")
    folder, replaced = result_folder(out, "plan", "plan.json", "trajectory.json", overwrite=overwrite)
    named = named_robot(robot)
    for words, flag in ((start, "--start"), (goal or ("home",), "--goal")):
        joint_values(words, named, flag)
    if goal_pose is not None:
        checked_pose(goal_pose, "--goal-pose")
    if margin not in (None, "auto"):
        margin_value(margin)

    import numpy as np

    from splatbot.atomic import replace_files, write_bytes, write_text
    from splatbot.cli.progress import steps
    from splatbot.cli.tables import print_command, print_text
    from splatbot.collision import GaussianCollisionField, RobotSpheres
    from splatbot.gaussians import GaussianModel
    from splatbot.grasping.grasp_file import GraspFile
    from splatbot.planning import GaussianRRTStar, PlanningError, PlanStatus, PoseGoal
    from splatbot.planning.closest import closest_approach
    from splatbot.report.plan_page import plan_html, plan_png
    from splatbot.robots.appearance import appearance, coarse_appearance
    from splatbot.robots.joint_offsets import robot_in_scene
    from splatbot.workspace import find_workspace

    arm = robot_in_scene(named, find_workspace(map))
    model = GaussianModel.load(file)
    T_world_base = base_pose(base, map)
    here = joint_values(start, arm, "--start")
    wanted: Any
    if goal_pose is not None:
        wanted = PoseGoal(T_world_base @ checked_pose(goal_pose, "--goal-pose"))
    elif grasp is not None:
        known = GraspFile.load(grasp)
        known.check_robot(arm.name, T_world_base)
        known.check_offsets(arm.joint_offsets)
        wanted = known.grasp(grasp_index, len(arm)).q_pregrasp
    else:
        wanted = joint_values(goal or (), arm, "--goal")
    with steps() as tell:
        tell("loading the map")
        of_map = GaussianCollisionField(model, n_sigma, min_observations=min_observations)
        keep = "auto" if margin is None and map.is_dir() else margin or "0"
        if unknown != "free":
            tell("searching for unknown space")
        spheres = RobotSpheres(arm, T_world_base=T_world_base)
        if keep == "auto":
            tell("searching for measured surface outside of the map")
        around = map_obstacles(
            map, of_map, model, spheres, here, unknown=unknown, support=support, measured=keep == "auto"
        )
        found = _plan(
            map,
            of_map,
            lambda least: GaussianRRTStar(around.field(least), arm, T_world_base=T_world_base, margin=least),
            lambda planner: planner.plan(here, wanted, budget_ms=budget_ms, seed=seed),
            here if goal_pose is not None else np.stack([here, wanted]),
            margin=keep,
            confidence=confidence,
            speed=speed,
            tell=tell,
        )
    result, trajectory = found.result, found.trajectory
    if result.path is None:
        _draw_refusal(folder / "refused.png", model, around, arm, found.planner, result, here, wanted)
    around.check(result)
    proposed = is_base_proposed(base, map)
    try:
        result.unwrap()
    except PlanningError as refused:
        if result.status is PlanStatus.START_STATE_IN_COLLISION and proposed:
            correct = f"splatbot info {map} --fit-plane --base-offset X Y Z"
            refused.hint = f"{refused.hint}; or correct the base, which is only proposed: {correct}"
        raise
    assert trajectory is not None
    covers = found.scope(around, confidence=confidence) | {"base_proposed": proposed}
    nearest = closest_approach(found.planner.arm, found.planner.field, trajectory, around.kind)
    title = f"{arm.name} in {map.resolve().name}"
    with steps() as tell:
        tell("drawing plan.html and plan.png")
        texts = {
            "plan.json": json.dumps(
                _summary(arm, T_world_base, result, trajectory)
                | {"nearest": None if nearest is None else nearest.to_dict(), "covers": covers},
                indent=2,
            ),
            "trajectory.json": trajectory.to_json(),
            "trajectory.csv": trajectory.to_csv(),
            "plan.html": plan_html(
                model, found.planner.arm, found.planner.field, trajectory, coarse_appearance(arm), arm.fk, title=title
            ),
        }
        writers = {name: write_text(text) for name, text in texts.items()}
        of_arm = (appearance(arm), arm.fk, arm.T_link_tcp)
        eye = None if seen_from is None else np.array(seen_from)
        picture = plan_png(model, found.planner.arm, trajectory, *of_arm, nearest=nearest, seen_from=eye)
        replace_files(folder, writers | {"plan.png": write_bytes(picture)})
        (folder / "refused.png").unlink(missing_ok=True)  # of an earlier plan
    _print(arm.name, result, trajectory, covers, nearest, written_to(folder, replaced))
    if grasp is not None:
        print_text("the approach to the grasp is not part of this plan; see `splatbot plan-pick` for the whole pick")
    of_plan = f"--map {map} --robot {robot}{base_words(base)} --trajectory {folder / 'trajectory.json'}"
    print_command(f"splatbot twin {of_plan}")
    return 0


def _plan(
    map_: Path,
    of_map: GaussianCollisionField,
    make_planner: Callable[[float], GaussianRRTStar],
    plan_once: Callable[[GaussianRRTStar], PlanResult],
    ends: NDArray[np.float64],
    *,
    margin: str,
    confidence: float,
    speed: float,
    tell: Callable[[str], None],
) -> RegionPlan:
    """Plan with a given margin, or with the audited margin of the region."""
    from splatbot.results.margin import audited_error
    from splatbot.results.region_plan import plan_at_margin, plan_in_region
    from splatbot.robots.in_view import reopen_log

    if margin == "auto":
        tell("auditing the error of the map")
        error = audited_error(map_, reopen_log(run_folder(map_, "--margin auto")), of_map)
        tell("planning with the error of the region as margin")
        return plan_in_region(make_planner, plan_once, ends, error, confidence=confidence, speed=speed)
    tell("planning")
    return plan_at_margin(make_planner(margin_value(margin)), plan_once, speed=speed)


def _draw_refusal(
    path: Path,
    model: GaussianModel,
    around: PlanObstacles,
    robot: RobotModel,
    planner: GaussianRRTStar,
    result: PlanResult,
    start: NDArray[np.float64],
    goal: Any,
) -> None:
    """Draw the end of a plan that is in collision; other refusals have no picture."""
    import numpy as np

    from splatbot.atomic import atomic_write
    from splatbot.geometry import inverse
    from splatbot.planning import PlanStatus, PoseGoal
    from splatbot.planning.causes import collision
    from splatbot.planning.ik import solve_ik
    from splatbot.report.plan_page import refused_png
    from splatbot.robots.appearance import appearance

    arm, field = planner.arm, planner.field
    ends = {PlanStatus.START_STATE_IN_COLLISION: start, PlanStatus.GOAL_IN_COLLISION: goal}
    q, cause = ends.get(result.status), result.cause
    if isinstance(q, PoseGoal):  # of its postures, that nearest to the start
        postures = solve_ik(robot, inverse(arm.T_world_base) @ np.asarray(q.T_world_tcp), near=start).q
        q = postures[0] if len(postures) else None
        cause = None if q is None else collision(arm, field, q)
    if not isinstance(q, np.ndarray) or cause is None or cause.at_base is None or cause.gaussian < 0:
        return
    picture = refused_png(
        model, arm, q, appearance(robot), robot.fk, point=np.array(cause.at_base),
        reason=cause.deep_in(around.kind(cause.gaussian)), solids=around.solids,
    )  # fmt: skip
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_write(path) as file:
        file.write(picture)
    print(f"picture of the collision: {path}", file=sys.stderr)


def _summary(
    arm: RobotModel, T_world_base: NDArray[np.float64], result: PlanResult, trajectory: JointTrajectory
) -> dict[str, Any]:
    assert result.path is not None
    c = trajectory.certificate
    return {
        "robot": arm.name,
        "joint_offsets": list(arm.joint_offsets),
        "joint_names": list(trajectory.names),
        "T_world_base": pose_values(T_world_base),
        "status": result.status.name,
        "code": int(result.status),
        "cost_rad": result.path.cost,
        "waypoints": result.path.waypoints.tolist(),
        "history": result.history.tolist(),
        "seconds": result.seconds,
        "duration_s": trajectory.duration,
        "certified": c.certified,
        "clearance_m": c.clearance,
        "margin_m": c.margin,
        "map_version": c.map_version,
    }


_LONG_DETOUR = 2.0
_DETOUR = "{:.1f} times the direct distance in joint space; a longer --budget-ms may shorten it"
_CLOSE = "less than 2 mm beyond the margin; a larger --margin keeps the arm farther away"
_SUPPORT = {
    True: "covered within reach, also where no frame saw it",
    False: "NOT COVERED beyond the map: no scene.yaml has it, the base is below it, or --no-support",
}
_MEASURED = {
    True: "covered: points outside of the map that two frames agree on",
    False: "points that the map lacks are NOT COVERED; --margin auto covers them",
}
_UNKNOWN = {
    "free": "not covered: counts as free",
    "cautious": "covered where two frames looked and measured no depth",
    "occupied": "covered: counts as occupied",
}


def _print(
    robot: str,
    result: PlanResult,
    trajectory: JointTrajectory,
    covers: dict[str, Any],
    nearest: ClosestApproach | None,
    folder: str,
) -> None:
    from splatbot.cli.tables import print_table
    from splatbot.planning.timing import clearance_text

    assert result.path is not None
    c = trajectory.certificate
    rows = [
        ("robot", robot),
        ("first path after", f"{1e3 * result.first_seconds:.2f} ms"),
        ("length", f"{result.path.cost:.3f} rad, {len(result.path)} waypoints"),
        *([("detour", _DETOUR.format(detour))] if (detour := _detour(result.path)) > _LONG_DETOUR else []),
        ("duration", f"{trajectory.duration:.3f} s"),
        ("certified", "yes" if c.certified else "NO"),
        ("clearance", clearance_text(c)),
        *([] if nearest is None else [("nearest", str(nearest))]),
        *([("close", _CLOSE)] if nearest is not None and nearest.close else []),
        ("covers", f"moving links against the map at {covers['n_sigma']:g} sigma and against the arm itself"),
        ("base", _base_text(covers)),
        (
            "hand",
            "covered, with the gripper fully open"
            if covers["hand"]
            else "not covered: this robot has none; see `splatbot robot list`",
        ),
        ("support plane", _SUPPORT[covers["support_plane"]]),
        ("measured", _MEASURED[covers["measured_surface"]]),
        ("unknown space", _UNKNOWN[covers["unknown_space"]]),
        ("margin", _margin_text(covers)),
        ("written to", folder),
    ]
    print_table(rows, title="planned")


def _detour(path: JointPath) -> float:
    """Return the length of a path in terms of the distance between its ends."""
    import numpy as np

    direct = float(np.linalg.norm(path.waypoints[-1] - path.waypoints[0]))
    return path.cost / direct if direct > 0.0 else 1.0


def _base_text(covers: dict[str, Any]) -> str:
    if covers["base_in_map"]:
        return "NOT COVERED, AND PROBABLY WRONG: more of the mounted link than its foot is in the map; check --base"
    if covers["base_proposed"]:
        return f"NOT COVERED, AND {PROPOSED_BASE}"
    return "not covered: the mounted link is not checked, and an error of its pose moves the whole arm"


def _margin_text(covers: dict[str, Any]) -> str:
    from splatbot.results.margin import least_points

    if covers["margin_from"] != "audit":
        return {"user": "as given", "none": "0, so that errors of the map are not covered"}[covers["margin_from"]]
    margin, error = (f"{1e3 * covers[name]:.1f} mm" for name in ("margin_m", "region_error_m"))
    larger = f"; the margin of {margin} is that of the points near start and goal, or near an earlier path"
    share, points = f"{100 * covers['confidence']:g} %", covers["region_points"]
    if points <= least_points(covers["confidence"]):  # the region had fewer
        which = f"the {points} measured points nearest to the motion, of which few are within 20 cm,"
    else:
        which = f"{share} of {points} measured points near the motion"
    return f"audited: {which} are within {error} of the map{larger if margin != error else ''}"

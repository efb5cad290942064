"""`splatbot plan`."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import tyro

from splatbot.cli.placing import Pose, base_pose, checked_pose, margin_of

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from splatbot.planning import JointTrajectory, PlanResult
    from splatbot.robots.robot import RobotModel


def plan(
    *,
    map: Annotated[Path, tyro.conf.arg(metavar="MAP")],
    start: Annotated[tuple[str, ...], tyro.conf.arg(metavar="Q ...")],
    goal: Annotated[tuple[str, ...] | None, tyro.conf.arg(metavar="Q ...")] = None,
    goal_pose: Annotated[Pose | None, tyro.conf.arg(metavar="X Y Z QW QX QY QZ")] = None,
    robot: str = "panda",
    base: Annotated[Pose | None, tyro.conf.arg(metavar="X Y Z QW QX QY QZ")] = None,
    margin: Annotated[str, tyro.conf.arg(metavar="M|auto")] = "0",
    n_sigma: float = 2.0,
    budget_ms: float = 100.0,
    seed: int = 0,
    out: Annotated[Path | None, tyro.conf.arg(metavar="DIR")] = None,
) -> int:
    """Plan a path of an arm among the Gaussians of a map.

    Writes the certified trajectory (trajectory.json as ROS JointTrajectory, trajectory.csv at 1 kHz), plan.json and
    plan.png. The page plan.html animates arm and map.

    Examples:
        splatbot plan --map runs/latest --start home --goal 0.5 -0.3 0 -2.0 0 1.9 0.8
        splatbot plan --map runs/latest --margin auto --start home --goal-pose 0.5 0.2 0.3 0 1 0 0
        splatbot plan --map map.ply --base 0 0.4 0 0.7071 -0.7071 0 0 --start home --goal home

    Args:
        map: a map file, or a run folder.
        start: joint values [rad or m], or "home".
        goal: joint values, or "home".
        goal_pose: pose of the tool instead of --goal, in the frame of the robot's base: position [m] and quaternion.
        robot: its name, as of `splatbot robot list`.
        base: pose of the robot's base in the map; by default that of the scene.yaml next to the map (see
            `splatbot info --fit-plane`).
        margin: clearance [m] to the map. With "auto" and a run folder, it is the error of the map's surfaces near the
            base, measured against the depth images of the run.
        n_sigma: surface of a Gaussian, in standard deviations.
        budget_ms: time budget of the planner [ms].
        seed: seed of the search.
        out: folder to write to; by default runs/plan.
    """
    from splatbot.errors import InputError

    if (goal is None) == (goal_pose is None):
        raise InputError("must be given, one of the two.", field="--goal, --goal-pose", hint="give joints or a pose")

    from splatbot.atomic import atomic_write
    from splatbot.collision import GaussianCollisionField
    from splatbot.gaussians import GaussianModel
    from splatbot.planning import GaussianRRTStar, PoseGoal, time_path
    from splatbot.report.plan_page import plan_html, plan_png
    from splatbot.robots.store import load_robot

    arm = load_robot(robot)
    file = map / "map.ply" if map.is_dir() else map
    model = GaussianModel.load(file)
    field = GaussianCollisionField(model, n_sigma)
    T_world_base = base_pose(base, map)
    planner = GaussianRRTStar(field, arm, T_world_base=T_world_base, margin=margin_of(margin, map, field, T_world_base))
    wanted: Any = (
        PoseGoal(T_world_base @ checked_pose(goal_pose, "--goal-pose"))
        if goal_pose is not None
        else _joints(goal or (), arm, "--goal")
    )
    result = planner.plan(_joints(start, arm, "--start"), wanted, budget_ms=budget_ms, seed=seed)
    path = result.unwrap()
    trajectory = time_path(path, planner.arm, field)
    folder = out if out is not None else Path("runs") / "plan"
    folder.mkdir(parents=True, exist_ok=True)
    title = f"{arm.name} in {map.resolve().name}"
    texts = {
        "plan.json": json.dumps(_summary(result, trajectory), indent=2),
        "trajectory.json": trajectory.to_json(),
        "trajectory.csv": trajectory.to_csv(),
        "plan.html": plan_html(model, planner.arm, field, trajectory, title=title),
    }
    for name, text in texts.items():
        with atomic_write(folder / name) as handle:
            handle.write(text.encode())
    with atomic_write(folder / "plan.png") as handle:
        handle.write(plan_png(model, planner.arm, trajectory))
    _print(result, trajectory, folder)
    return 0


def _joints(words: tuple[str, ...], robot: RobotModel, flag: str) -> NDArray[np.float64]:
    import numpy as np

    from splatbot.errors import InputError

    if words == ("home",):
        return np.asarray(robot.home)
    try:
        values = np.array([float(word) for word in words])
    except ValueError as error:
        raise InputError(f"is {' '.join(words)}.", field=flag, hint='give numbers, or "home"') from error
    if len(values) != len(robot) or not np.isfinite(values).all():
        raise InputError(f"has {len(values)} values.", field=flag, hint=f"{robot.name} has {len(robot)} joints")
    return values


def _summary(result: PlanResult, trajectory: JointTrajectory) -> dict[str, Any]:
    assert result.path is not None
    c = trajectory.certificate
    return {
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


def _print(result: PlanResult, trajectory: JointTrajectory, folder: Path) -> None:
    from splatbot.cli.tables import print_table

    assert result.path is not None
    c = trajectory.certificate
    rows = [
        ("first path after", f"{1e3 * result.first_seconds:.2f} ms"),
        ("length", f"{result.path.cost:.3f} rad, {len(result.path)} waypoints"),
        ("duration", f"{trajectory.duration:.3f} s"),
        ("certified", "yes" if c.certified else "NO"),
        ("clearance along the path", f"{1e3 * c.clearance:.1f} mm beyond a margin of {1e3 * c.margin:.1f} mm"),
        ("written to", str(folder)),
    ]
    print_table(rows, title="planned")

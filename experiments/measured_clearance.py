"""Measure how near certified paths pass measured points: `python -m experiments.measured_clearance RUN ...`.

The paths are those of `splatbot plan` in a run folder with its defaults. The margin is the audited error of the region
of each motion, and the support plane is an obstacle. The audit samples 5,000 pixels of 40 frames; here all pixels
of all frames propose points. A point counts if another frame measures the same depth there. The script needs no truth.

A path keeps the margin from the map. A point that is outside of the map may be nearer by the distance between both.
"""

from __future__ import annotations

import inspect
import sys
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from splatbot.bench.planning.recorded_run import free_place
from splatbot.bench.planning_problems import Problem, map_problems
from splatbot.cli.plan import plan
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.collision.confirmed import confirmed_near
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.planning import GaussianRRTStar
from splatbot.protocols import Array
from splatbot.results.folder import RunFolder
from splatbot.results.margin import CONSTANTS as MARGIN
from splatbot.results.margin import AuditedError, audited_error
from splatbot.results.measured import MeasuredSurface
from splatbot.results.plan_obstacles import PlanObstacles
from splatbot.results.region_plan import RegionPlan, plan_in_region
from splatbot.results.views import raw_views
from splatbot.robots.in_view import reopen_log
from splatbot.robots.panda import panda
from splatbot.sim.compare.agreement import wilson
from splatbot.workspace import find_workspace, fit_workspace


@dataclass(frozen=True)
class MeasuredClearanceConstants:
    """Constants of the comparison.

    Args:
        paths: number of paths of a run.
        problems_per_path: largest number of problems for each path; the ends of some are not free with the margin.
        voxel: [m] edge of the voxels in which a frame proposes at most one point.
        max_points: largest number of proposed points.
        max_frames: largest number of frames.
        step: [rad] mean distance between compared configurations.
        search: [m] distance beyond the margin in which a nearest point is searched.
    """

    paths: int = 100
    problems_per_path: int = 4
    voxel: float = 0.001
    max_points: int = 10_000_000
    max_frames: int = 1000
    step: float = 1 / 256
    search: float = 0.05


CONSTANTS = MeasuredClearanceConstants()
_PLAN = {name: parameter.default for name, parameter in inspect.signature(plan).parameters.items()}


@dataclass(frozen=True, eq=False)
class MappedScene:
    """The map of a run with an arm, and its measured points.

    Args:
        model, field: the map.
        T_world_base: (4, 4) pose of the arm [m].
        plane: (4,) support plane [m, world], or None.
        box: (2, 3) corners of the workspace [m, base].
        error: audited error of the map.
        measured: (M, 4) spheres around measured surface outside of the map [m, world], as in `splatbot plan`.
        points: (P, 3) points in reach that two frames measure [m, world].
    """

    model: GaussianModel
    field: GaussianCollisionField
    T_world_base: Array
    plane: Array | None
    box: Array
    error: AuditedError
    measured: Array
    points: Array


@dataclass(frozen=True)
class PathClearance:
    """Distances of a path.

    Args:
        margin: stated distance from the map [m].
        gap: least distance from a measured point [m], negative inside of the arm.
        outside: distance of that point from the map [m].
    """

    margin: float
    gap: float
    outside: float


def open_scene(run: Path) -> MappedScene:
    """Open a run, place the arm as `splatbot bench planning --run` does, and find the measured points in its reach."""
    folder = RunFolder(run)
    model = GaussianModel.load(run / "map.ply")
    field = GaussianCollisionField(model, _PLAN["n_sigma"], min_observations=_PLAN["min_observations"])
    place = find_workspace(run) or free_place(field, fit_workspace(model))
    if place.T_world_base is None or place.box is None:
        hint = "give both, or no scene.yaml"
        raise InputError("is not known.", file=run / "scene.yaml", field="T_world_base, workspace", hint=hint)
    log, sensor, robot = reopen_log(folder), folder.load_config().sensor, panda()
    reach, base = robot.chain.reach(robot.T_link_tcp), place.T_world_base[:3, 3]
    points = confirmed_near(
        raw_views(folder, log, CONSTANTS.max_frames)[1],
        base - reach,
        base + reach,
        floor=sensor.sigma_depth_floor,
        quad=sensor.sigma_depth_quad,
        spacing=CONSTANTS.voxel,
        most=CONSTANTS.max_points,
        agreeing_views=MARGIN.agreeing_views,
    )
    error = audited_error(run, log, field)
    arm = RobotSpheres(robot, T_world_base=place.T_world_base)
    measured = MeasuredSurface(folder, partial(reopen_log, folder), model, field).near(arm)
    return MappedScene(model, field, place.T_world_base, place.support_plane, place.box, error, measured, points)


def measure(scene: MappedScene, paths: int, seed: int = 0) -> tuple[list[PathClearance], int]:
    """Plan until ``paths`` are certified; return their distances from measured points, and the number of problems."""
    own = scene.error.near(scene.T_world_base[:3, 3], MARGIN.radius).quantile(_PLAN["confidence"])
    arm = RobotSpheres(panda(), T_world_base=scene.T_world_base, margin=own)
    problems = map_problems(panda(), arm, scene.field, scene.box, CONSTANTS.problems_per_path * paths, seed)
    tree, tried = cKDTree(scene.points), 0
    found: list[PathClearance] = []
    for planned in _plans(scene, problems):
        tried += 1
        if planned is not None:
            found.append(_path_clearance(scene, planned, tree))
        if len(found) == paths:
            break
    return found, tried


def nearest_point(arm: RobotSpheres, q: Array, points: cKDTree, cut: float) -> tuple[float, int]:
    """Return the least distance [m] of the moving links at ``q`` (C, J) from points, and the index of that point.

    The distance is at most ``cut``; without a point within it the index is the number of points. The first of eight
    successive configurations bounds the distances of the others by the motion of each sphere.
    """
    moving = arm.spheres.link > 0
    radii = arm.spheres.radii[moving]
    q = np.concatenate([q, np.tile(q[-1], (-len(q) % 8, 1))])
    centers = arm.centers(q)[:, moving].reshape(-1, 8, len(radii), 3).swapaxes(1, 2)
    moved = np.linalg.norm(centers - centers[:, :, :1], axis=3).max(axis=2)
    reach = cut + float(radii.max()) + float(moved.max())
    first = points.query(centers[:, :, 0], distance_upper_bound=reach)[0] - radii
    block, sphere = np.nonzero(first - moved <= min(cut, first.min()))
    away, index = points.query(centers[block, sphere], distance_upper_bound=reach)
    gaps = away - radii[sphere, None]
    gap = float(gaps.min(initial=np.inf))
    return (gap, int(index.ravel()[gaps.argmin()])) if gap < cut else (cut, points.n)


def _plans(scene: MappedScene, problems: Sequence[Problem]) -> Iterator[RegionPlan | None]:
    """Plan each problem as `splatbot plan`; None without a path."""
    for problem in problems:
        try:
            planned = _plan(scene, problem)
        except InputError:  # each path requires a larger margin
            yield None
        else:
            yield planned if planned.trajectory is not None else None


def _plan(scene: MappedScene, problem: Problem) -> RegionPlan:
    robot, T = panda(), scene.T_world_base
    arm = RobotSpheres(robot, T_world_base=T)
    around = PlanObstacles(scene.field, scene.model, arm, problem.start, plane=scene.plane, measured=scene.measured)
    return plan_in_region(
        lambda margin: GaussianRRTStar(around.field(margin), robot, T_world_base=T, margin=margin),
        lambda planner: planner.plan(problem.start, problem.goal, budget_ms=_PLAN["budget_ms"], seed=_PLAN["seed"]),
        np.stack([problem.start, problem.goal]),
        scene.error,
        confidence=_PLAN["confidence"],
        speed=_PLAN["speed"],
    )


def _path_clearance(scene: MappedScene, planned: RegionPlan, points: cKDTree) -> PathClearance:
    assert planned.trajectory is not None
    assert planned.result.path is not None
    arm, margin = planned.planner.arm, planned.planner.margin
    count = int(np.ceil(planned.result.path.cost / CONSTANTS.step)) + 1
    q = planned.trajectory.at(np.linspace(0.0, planned.trajectory.duration, count)).position
    gap, index = nearest_point(arm, q, points, margin + CONSTANTS.search)
    outside = 0.0
    if index < len(scene.points):
        outside = max(0.0, float(scene.field.clearance(scene.points[index : index + 1]).distance[0]))
    return PathClearance(margin, gap, outside)


def report(found: Sequence[PathClearance], tried: int) -> str:
    """Return the counts of paths, with 95 % intervals (Wilson 1927), and distances in words."""
    margin, gap, outside = np.array([(p.margin, p.gap, p.outside) for p in found]).T
    short, near = margin - gap, gap < margin
    lines = [
        f"{len(found)} paths of {tried} problems, margin {1e3 * np.median(margin):.1f} mm in the median",
        f"in contact with a measured point: {_share(gap < 0)}",
        f"nearer than the margin: {_share(near)}",
    ]
    if near.any():
        small, most = 1e3 * np.median(short[near]), 1e3 * short[near].max()
        lines += [
            f"nearer by {small:.1f} mm in the median, {most:.1f} mm at most",
            f"nearest point outside of the map by more than the margin: {_share(near & (outside > margin))}",
        ]
    lines.append(f"nearer than the margin less the distance of point and map: {_share(gap < margin - outside - 1e-4)}")
    return "\n".join(lines)


def _share(chosen: NDArray[np.bool_]) -> str:
    interval = wilson(int(chosen.sum()), len(chosen))
    assert interval.low is not None
    assert interval.high is not None
    return f"{int(chosen.sum())} of {len(chosen)} ({100 * interval.low:.0f} to {100 * interval.high:.0f} %)"


def main(argv: Sequence[str]) -> None:
    """Print the counts of each run."""
    if not argv:
        raise SystemExit("give run folders: python -m experiments.measured_clearance RUN ...")
    for name in argv:
        scene = open_scene(Path(name))
        print(f"{name}: {len(scene.points):,} points that two frames measure", flush=True)
        found, tried = measure(scene, CONSTANTS.paths)
        if not found:
            print(f"none of {tried} problems has a path")
            continue
        print(report(found, tried), flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])

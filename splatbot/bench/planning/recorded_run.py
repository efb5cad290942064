"""Planning on maps of recordings; paths are compared with the measured depth images."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from splatbot.bench.collision.recorded_run import lifted
from splatbot.bench.planning.audit import configurations
from splatbot.bench.planning.margin_sweep import sweep_margins
from splatbot.bench.planning_problems import Problem, map_problems
from splatbot.bench.results import Results
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.geometry import so3_exp
from splatbot.logs import Log
from splatbot.planning import GaussianRRTStar, PlanResult
from splatbot.protocols import Array
from splatbot.results.audit import audit_run
from splatbot.results.folder import RunFolder
from splatbot.results.margin import CONSTANTS as MARGIN
from splatbot.results.margin import audited_error
from splatbot.results.region_plan import RegionPlan, plan_in_region
from splatbot.robots.in_view import reopen_log
from splatbot.robots.panda import panda
from splatbot.tracking.prepare import usable_depth
from splatbot.workspace import CONSTANTS as WORKSPACE
from splatbot.workspace import Workspace, find_workspace, fit_workspace


@dataclass(frozen=True)
class RecordedRunConstants:
    """Constants of paths on recorded logs.

    Args:
        min_frames: least number of frames whose depth is compared with the paths.
        pixel_stride: stride between the compared pixels.
        tried_configurations: number of configurations that are tried.
        min_free_share: least fraction of free configurations.
        path_stride: stride between the compared configurations of a path: 1/32 rad.
    """

    min_frames: int = 40
    pixel_stride: int = 5
    tried_configurations: int = 1000
    min_free_share: float = 0.1
    path_stride: int = 8


CONSTANTS = RecordedRunConstants()


_TURNS = (0, *(sign * angle for angle in range(30, 181, 30) for sign in (1, -1)))  # [deg]
_BOX = ((0.2, -0.5, 0.0), (0.9, 0.5, 0.8))  # [m]


def plan_in_run(
    results: Results, run: Path, *, problems: int, budget_ms: float, seed: int = 0, margins: bool = False
) -> None:
    """Plan seeded problems in the map of a run, with three margins.

    They are 0, the surface error of the map within 1 m of the base, and that in the region of each motion. The last one
    is the default of `splatbot plan`.

    With ``margins``, also sweep the margin on the problems of margin 0 (:mod:`splatbot.bench.planning.margin_sweep`).

    The scene.yaml of the run defines the pose of the base. Without a scene.yaml,
    :func:`splatbot.workspace.fit_workspace` proposes it, and :func:`free_place` turns it until the arm can move.

    Raises:
        InputError: The map has no plane, or its scene.yaml lacks the base or the workspace.
    """
    model = GaussianModel.load(run / "map.ply")
    field = GaussianCollisionField(model)
    place = find_workspace(run) or free_place(field, fit_workspace(model))
    if place.T_world_base is None or place.box is None:
        raise InputError(
            "is not known.",
            file=run / "scene.yaml",
            field="T_world_base, workspace",
            hint="give both, or no scene.yaml",
        )
    folder = RunFolder(run)
    log = reopen_log(folder)
    error = audited_error(run, log, field)
    own = error.near(place.T_world_base[:3, 3], MARGIN.radius).quantile(MARGIN.confidence)
    known = {
        "a measured point": cKDTree(_measured(folder, log)),
        "a point that two frames measured": cKDTree(error.points),
    }
    name = run.resolve().name
    for margin in (0.0, own):
        case = f"{name}, margin {1e3 * margin:.1f} mm"
        planner = GaussianRRTStar(field, panda(), T_world_base=place.T_world_base, margin=margin)
        wanted = map_problems(panda(), planner.arm, field, place.box, problems, seed)
        results.add(case, "Gaussians", float(len(field)), "")
        results.add(case, "problems found", float(len(wanted)), f"of {problems}")
        runs = [planner.plan(p.start, p.goal, budget_ms=budget_ms, seed=k) for k, p in enumerate(wanted)]
        _add(results, case, runs, planner.arm, known)
        if margins and margin == 0.0:
            audit = audit_run(folder, log).audit
            sweep_margins(results, name, audit, field, place.T_world_base, wanted, budget_ms=budget_ms)
    case = f"{name}, margin of the region"

    def in_region(number: int, problem: Problem) -> RegionPlan:
        return plan_in_region(
            lambda margin: GaussianRRTStar(field, panda(), T_world_base=place.T_world_base, margin=margin),
            lambda planner: planner.plan(problem.start, problem.goal, budget_ms=budget_ms, seed=number),
            np.stack([problem.start, problem.goal]),
            error,
            confidence=MARGIN.confidence,
        )

    found = [in_region(k, p) for k, p in enumerate(wanted)]
    results.add(case, "problems found", float(len(wanted)), f"of {problems}")
    if found:
        results.add(case, "margin, median", 1e3 * float(np.median([one.planner.margin for one in found])), "mm")
    _add(results, case, [one.result for one in found], planner.arm, known)


def free_place(field: GaussianCollisionField, place: Workspace) -> Workspace:
    """Turn a proposed workspace about the centre of its surface until enough configurations are free.

    A turned workspace gets the box in reach in front of the arm. If no turn is free enough, the workspace is unchanged.
    """
    T = place.T_world_base
    assert T is not None
    some = panda().random(CONSTANTS.tried_configurations, np.random.default_rng(0))
    for degrees in _TURNS:
        turn = np.eye(4)
        turn[:3, :3] = so3_exp([0.0, 0.0, np.radians(degrees)])
        turn[:3, 3] = [WORKSPACE.ahead, 0.0, 0.0] - turn[:3, :3] @ [WORKSPACE.ahead, 0.0, 0.0]
        arm = RobotSpheres(panda(), T_world_base=T @ turn)
        if (~arm.check(field, some).in_collision).mean() > CONSTANTS.min_free_share:
            return place if degrees == 0 else replace(place, T_world_base=T @ turn, box=np.array(_BOX))
    return place


def _add(results: Results, case: str, runs: list[PlanResult], arm: RobotSpheres, known: Mapping[str, cKDTree]) -> None:
    if not runs:
        return
    paths = [run.path for run in runs if run.path is not None]
    results.add(case, "solved", float(len(paths)), f"of {len(runs)}")
    results.add(case, "planning time, median", 1e3 * float(np.median([run.seconds for run in runs])), "ms")
    if not paths:
        return
    first = [1e3 * run.first_seconds for run in runs if run]
    results.add(case, "certified", float(sum(path.certificate.certified for path in paths)), f"of {len(paths)}")
    results.add(case, "first path, median", float(np.median(first)), "ms")
    results.add(case, "first path, most", max(first), "ms")
    results.add(case, "cost, mean", float(np.mean([path.cost for path in paths])), "rad")
    promised = [1e3 * path.certificate.clearance for path in paths]
    results.add(case, "certified clearance beyond the margin, least", min(promised), "mm")
    results.add(case, "certified clearance beyond the margin, median", float(np.median(promised)), "mm")
    for name, points in known.items():
        clearances = np.array([_clearance(arm, path.waypoints, points) for path in paths])
        results.add(case, f"in contact with {name}", float((clearances <= 0).sum()), f"of {len(paths)}")
        results.add(case, f"deepest in {name}", 1e3 * max(0.0, -float(clearances.min())), "mm")


def _measured(folder: RunFolder, log: Log) -> Array:
    """Return the points (P, 3) [m, world] of the log's depth that mapping uses."""
    config = folder.load_config().tracking
    poses = sorted(folder.load_poses().items())
    parts = []
    for index, T in poses[:: max(1, len(poses) // CONSTANTS.min_frames)]:
        frame = log[index]
        depth = usable_depth(frame, config)
        v, u = np.nonzero(np.isfinite(depth) & (depth > 0))
        parts.append(lifted(depth, u[:: CONSTANTS.pixel_stride], v[:: CONSTANTS.pixel_stride], frame.camera, T))
    return np.concatenate(parts)


def _clearance(arm: RobotSpheres, path: Array, measured: cKDTree) -> float:
    """Compute the least clearance [m] between the arm along a path and measured points, at most 10 cm."""
    moving = arm.spheres.link > 0
    centers = arm.centers(configurations(path)[:: CONSTANTS.path_stride])[:, moving]
    distance, _ = measured.query(centers.reshape(-1, 3), distance_upper_bound=0.1 + float(arm.spheres.radii.max()))
    gap = np.minimum(distance.reshape(len(centers), -1) - arm.spheres.radii[moving], 0.1)
    return float(gap.min())

"""The planner's problems on a map of a noisy film of their table top, over margins, against exact truth."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
import open3d as o3d
from numpy.typing import NDArray

from splatbot.bench.collision.peers import mesh_of
from splatbot.bench.film import Film, FilmedMap
from splatbot.bench.planning.audit import configurations
from splatbot.bench.planning_problems import Problem
from splatbot.bench.results import Results
from splatbot.bench.truth import Truth
from splatbot.collision import GaussianCollisionField, RobotSpheres, surface_error
from splatbot.planning import GaussianRRTStar, PlanResult, PlanStatus
from splatbot.protocols import Array
from splatbot.results.margin import RADIUS, SHARE
from splatbot.robots.panda import panda

MARGINS = (0.0, 0.005, 0.02)  # [m] beside the map's own
_SOUGHT = (PlanStatus.SUCCESS, PlanStatus.TIMED_OUT, PlanStatus.PLANNING_FAILED)


@dataclass(frozen=True, eq=False)
class TrueClearances:
    """What exact distances say of paths.

    Args:
        rooms: least true room (P,) [m] of each path, negative inside a shape.
        seen: whether each path (P,) touches a place of the true surface that some frame shows.
    """

    rooms: Array
    seen: NDArray[np.bool_]


def add_map(results: Results, mapped: FilmedMap) -> float:
    """What the map is like; returns the margin [m] that it asks for itself."""
    case = "mapped noisy log"
    field = GaussianCollisionField(mapped.snapshot)
    own = surface_error(field, mapped.views(), around=[*mapped.T_map_scene[:3, 3], RADIUS]).share(SHARE)
    drift = mapped.drift()
    results.add(case, "frames", float(len(drift)), "")
    results.add(case, "lost", float(np.isnan(drift).sum()), f"of {len(drift)}")
    results.add(case, "camera off, median", 1e3 * float(np.nanmedian(drift)), "mm")
    results.add(case, "camera off, most", 1e3 * float(np.nanmax(drift)), "mm")
    results.add(case, "Gaussians", float(len(field)), "")
    results.add(case, f"surface error within {RADIUS:g} m, as its depth tells, {SHARE:.1%}", 1e3 * own, "mm")
    return own


def audit_mapped(
    results: Results,
    name: str,
    mapped: FilmedMap,
    truth: Truth,
    wanted: Sequence[Problem],
    own: float,
    *,
    seeds: int,
    budget_ms: float,
) -> None:
    """All problems with all seeds on the map, over margins from 0 to 2 cm and with the map's ``own`` [m].

    Costs are told beside those of margin 0, over the problems that both solved.
    """
    field = GaussianCollisionField(mapped.snapshot)
    base = mapped.T_map_scene
    bare = RobotSpheres(panda())
    reference: Array | None = None
    for margin in sorted({*MARGINS, own}):
        case = f"{name}, margin {1e3 * margin:.1f} mm" + (" (its own)" if margin == own else "")
        planner = GaussianRRTStar(field, panda(), T_world_base=base, margin=margin)
        begin = time.perf_counter()
        runs = [
            planner.plan(problem.start, problem.goal, budget_ms=budget_ms, seed=seed)
            for seed in range(seeds)
            for problem in wanted
        ]
        spent = time.perf_counter() - begin
        costs = np.array([np.nan if run.path is None else run.path.cost for run in runs])
        reference = costs if reference is None else reference
        _add_success(results, case, runs, 1e3 * spent / len(runs))
        _add_cost(results, case, costs, reference)
        paths = [run.path.waypoints for run in runs if run.path is not None]
        if paths:
            _add_touches(results, case, touches(paths, bare, truth, mapped.film))


def touches(paths: Sequence[Array], arm: RobotSpheres, truth: Truth, film: Film) -> TrueClearances:
    """How the configurations of paths, every 1/256 rad, lie to the true shapes in whose frame the arm stands."""
    shapes = _shapes(truth)
    moving = arm.spheres.link > 0
    rooms, seen = [], []
    for path in paths:
        q = configurations(path)
        room = truth.rooms(arm, q)
        rooms.append(float(room.min()))
        inside = np.zeros((0, 3))
        if rooms[-1] <= 0:
            centers = arm.centers(q[room <= 0])[:, moving].reshape(-1, 3)
            radii = np.tile(arm.spheres.radii[moving], int((room <= 0).sum()))
            inside = centers[truth.scene.distance(centers) <= radii]
        seen.append(bool(film.seen(_closest(shapes, inside)).any()) if len(inside) else False)
    return TrueClearances(np.array(rooms), np.array(seen, np.bool_))


def _add_success(results: Results, case: str, runs: Sequence[PlanResult], mean_ms: float) -> None:
    blocked = sum(run.status not in _SOUGHT for run in runs)
    results.add(case, "start or goal not free on the map", float(blocked), f"of {len(runs)}")
    solved = [run.path for run in runs if run.path is not None]
    results.add(case, "solved", float(len(solved)), f"of {len(runs)}")
    results.add(case, "solved of those free at both ends", float(len(solved)), f"of {len(runs) - blocked}")
    results.add(case, "the whole call, mean", mean_ms, "ms")
    if solved:
        first = [1e3 * run.first_seconds for run in runs if run]
        results.add(case, "first path, median", float(np.median(first)), "ms")
        results.add(case, "first path, 95 %", float(np.percentile(first, 95)), "ms")
        clearance = 1e3 * float(np.median([path.certificate.clearance for path in solved]))
        results.add(case, "clearance promised beyond the margin, median", clearance, "mm")


def _add_cost(results: Results, case: str, costs: Array, reference: Array) -> None:
    both = np.isfinite(costs) & np.isfinite(reference)
    if both.any():
        results.add(case, "cost, mean", float(np.nanmean(costs)), "rad")
        ratio = float((costs[both] / reference[both]).mean())
        results.add(case, "cost against margin 0 where both solved, mean", ratio, "x")


def _add_touches(results: Results, case: str, found: TrueClearances) -> None:
    touch = found.rooms <= 0
    count = f"of {len(touch)}"
    results.add(case, "touch the truth", float(touch.sum()), count)
    results.add(case, "touch what a frame showed", float((touch & found.seen).sum()), count)
    results.add(case, "deepest", 1e3 * max(0.0, -float(found.rooms.min())), "mm")
    deepest = -float(found.rooms[found.seen].min()) if found.seen.any() else 0.0
    results.add(case, "deepest of those", 1e3 * deepest, "mm")


def _shapes(truth: Truth) -> o3d.t.geometry.RaycastingScene:
    vertices, triangles = mesh_of(truth.scene)
    shapes = o3d.t.geometry.RaycastingScene()
    shapes.add_triangles(_tensor(vertices), o3d.core.Tensor.from_numpy(triangles.astype(np.uint32)))
    return shapes


def _closest(shapes: o3d.t.geometry.RaycastingScene, points: Array) -> Array:
    return np.asarray(shapes.compute_closest_points(_tensor(points))["points"].numpy(), dtype=np.float64)


def _tensor(points: Array) -> o3d.core.Tensor:
    return o3d.core.Tensor.from_numpy(np.ascontiguousarray(points, dtype=np.float32))

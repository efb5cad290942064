"""Planning problems on a map of a noisy film of the table top, over margins, against exact ground truth."""

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
from splatbot.results.margin import CONSTANTS as MARGIN
from splatbot.robots.panda import panda

MARGINS = (0.0, 0.005, 0.02)  # [m] in addition to the surface error of the map
_SEARCHED = (PlanStatus.SUCCESS, PlanStatus.TIMED_OUT, PlanStatus.PLANNING_FAILED)


@dataclass(frozen=True, eq=False)
class TrueClearances:
    """Exact clearances of paths.

    Args:
        clearances: Least true clearance (P,) [m] of each path, negative inside a shape.
        observed: True for each path (P,) in contact with surface that some frame observes.
    """

    clearances: Array
    observed: NDArray[np.bool_]


def add_map(results: Results, mapped: FilmedMap) -> float:
    """Add size and errors of the map, and return its surface error [m], which serves as a margin."""
    case = "mapped noisy log"
    field = GaussianCollisionField(mapped.snapshot)
    own = surface_error(field, mapped.views(), around=[*mapped.T_map_scene[:3, 3], MARGIN.radius]).share(
        MARGIN.confidence
    )
    drift = mapped.drift()
    results.add(case, "frames", float(len(drift)), "")
    results.add(case, "lost", float(np.isnan(drift).sum()), f"of {len(drift)}")
    results.add(case, "camera position error, median", 1e3 * float(np.nanmedian(drift)), "mm")
    results.add(case, "camera position error, most", 1e3 * float(np.nanmax(drift)), "mm")
    results.add(case, "Gaussians", float(len(field)), "")
    results.add(
        case,
        f"surface error within {MARGIN.radius:g} m against its own depth, {MARGIN.confidence:.1%}",
        1e3 * own,
        "mm",
    )
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
    """Plan all problems with all seeds on the map, over margins from 0 to 2 cm and with the surface error ``own`` [m].

    Costs are compared with those of margin 0, over the problems that both solved.
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
            _add_contacts(results, case, true_clearances(paths, bare, truth, mapped.film))


def true_clearances(paths: Sequence[Array], arm: RobotSpheres, truth: Truth, film: Film) -> TrueClearances:
    """Compute true clearances of paths every 1/256 rad; the frame of the shapes is that of the arm's base."""
    shapes = _shapes(truth)
    moving = arm.spheres.link > 0
    clearances, observed = [], []
    for path in paths:
        q = configurations(path)
        clearance = truth.clearances(arm, q)
        clearances.append(float(clearance.min()))
        inside = np.zeros((0, 3))
        if clearances[-1] <= 0:
            centers = arm.centers(q[clearance <= 0])[:, moving].reshape(-1, 3)
            radii = np.tile(arm.spheres.radii[moving], int((clearance <= 0).sum()))
            inside = centers[truth.scene.distance(centers) <= radii]
        observed.append(bool(film.observed(_closest(shapes, inside)).any()) if len(inside) else False)
    return TrueClearances(np.array(clearances), np.array(observed, np.bool_))


def _add_success(results: Results, case: str, runs: Sequence[PlanResult], mean_ms: float) -> None:
    blocked = sum(run.status not in _SEARCHED for run in runs)
    results.add(case, "start or goal not free on the map", float(blocked), f"of {len(runs)}")
    solved = [run.path for run in runs if run.path is not None]
    results.add(case, "solved", float(len(solved)), f"of {len(runs)}")
    results.add(case, "solved of those free at both ends", float(len(solved)), f"of {len(runs) - blocked}")
    results.add(case, "planning time, mean", mean_ms, "ms")
    if solved:
        first = [1e3 * run.first_seconds for run in runs if run]
        results.add(case, "first path, median", float(np.median(first)), "ms")
        results.add(case, "first path, 95 %", float(np.percentile(first, 95)), "ms")
        clearance = 1e3 * float(np.median([path.certificate.clearance for path in solved]))
        results.add(case, "certified clearance beyond the margin, median", clearance, "mm")


def _add_cost(results: Results, case: str, costs: Array, reference: Array) -> None:
    both = np.isfinite(costs) & np.isfinite(reference)
    if both.any():
        results.add(case, "cost, mean", float(np.nanmean(costs)), "rad")
        ratio = float((costs[both] / reference[both]).mean())
        results.add(case, "cost against margin 0 where both solved, mean", ratio, "x")


def _add_contacts(results: Results, case: str, found: TrueClearances) -> None:
    contact = found.clearances <= 0
    count = f"of {len(contact)}"
    results.add(case, "in contact with the true shapes", float(contact.sum()), count)
    results.add(case, "in contact with observed surface", float((contact & found.observed).sum()), count)
    results.add(case, "deepest", 1e3 * max(0.0, -float(found.clearances.min())), "mm")
    deepest = -float(found.clearances[found.observed].min()) if found.observed.any() else 0.0
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

"""Measurements of `splatbot bench planning`: paths over time budgets, changes of the map, memory, and peers."""

from __future__ import annotations

import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch

from splatbot.bench.benchmark import ReportProgress, ignore_progress
from splatbot.bench.film import map_film, shoot
from splatbot.bench.machine import describe_machine
from splatbot.bench.planning import FAR_CHANGE, MEMORY, NEAR_CHANGE, PlanningSettings
from splatbot.bench.planning.audit import audit
from splatbot.bench.planning.mapped_log import add_map, audit_mapped
from splatbot.bench.planning.peers import run_peers
from splatbot.bench.planning.recorded_run import plan_in_run
from splatbot.bench.planning_problems import CONSTANTS as PROBLEMS
from splatbot.bench.planning_problems import Problem, problems
from splatbot.bench.results import Results
from splatbot.bench.tabletop import tabletop
from splatbot.bench.timing import threads
from splatbot.bench.truth import Truth
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.gaussians import GaussianModel
from splatbot.planning import GaussianRRTStar, PlanResult, Replanner
from splatbot.protocols import Array
from splatbot.robots.panda import panda


@dataclass(frozen=True)
class BudgetConstants:
    """Constants of plans under a time budget."""

    exact_clearance: float = 0.01
    """True clearance [m] up to which it is exact; above it is a lower bound, and is compared with this value."""
    fast_ms: float = 28.0
    """Budget [ms] of the path before a change of the map, and of paths on mapped logs. A larger one solves more
    problems, with shorter paths."""
    repair_ms: float = 9.0
    """Budget [ms] of a repair. A larger one repairs more paths."""
    wide_clearance: float = 0.03
    """True clearance [m] at both ends, which leaves them free on a map with a margin of 2 cm."""
    solvable_ms: float = 100.0
    """Time [ms] in which a changed problem must be solved again to count. A larger one counts harder problems."""


CONSTANTS = BudgetConstants()


def run_planning(settings: PlanningSettings, report_progress: ReportProgress = ignore_progress) -> Results:
    """Measure budgets, changes of the map, memory and peers of the settings, on one thread."""
    report_progress("measuring the machine")
    results = Results(describe_machine((1,), peak_ms=settings.peak_ms))
    scene = tabletop()
    model = scene.gaussians(settings.gaussians)
    with threads(1):
        planner = GaussianRRTStar(GaussianCollisionField(model), panda())
        truth = Truth(scene, 0.1 if settings.quick else 0.02)
        wanted = problems(panda(), planner.arm, planner.field, truth, settings.problems)
        costs: dict[float, Array] = {}
        for budget in settings.budgets:
            report_progress(f"budget {budget:g} ms")
            costs[budget] = run_budget(settings, results, planner, truth, wanted, budget)
            settings.save(results)
        report_progress("maps that change")
        run_changes(settings, results, model, wanted)
        add_memory(results, scene.gaussians(settings.memory_gaussians), planner)
        if settings.peers:
            run_peers(results, scene, planner, wanted, settings.peer_budgets, costs, audit, truth, report_progress)
    return results


def run_mapped(settings: PlanningSettings, report_progress: ReportProgress = ignore_progress) -> Results:
    """Plan on a map of a noisy film (``settings.mapped``) and in the maps of ``settings.run``, on one thread.

    Raises:
        FormatError: A run is damaged.
        LogError: The log of a run does not exist any more.
        InputError: The map of a run has no place for an arm.
    """
    report_progress("measuring the machine")
    results = Results(describe_machine((1,), peak_ms=settings.peak_ms))
    with threads(1):
        if settings.mapped:
            scene = tabletop()
            report_progress(f"filming and mapping {settings.film[0]} frames")
            mapped = map_film(shoot(scene, *settings.film))
            truth = Truth(scene, 0.1 if settings.quick else 0.02)
            ideal = GaussianCollisionField(scene.gaussians(settings.gaussians))
            own = add_map(results, mapped)
            # The coarse grid of a quick run bounds clearances too low for the wide one.
            for clearance in (
                (PROBLEMS.min_clearance,) if settings.quick else (PROBLEMS.min_clearance, CONSTANTS.wide_clearance)
            ):
                name = f"ends with {1e3 * clearance:g} mm on a mapped noisy log"
                report_progress(name)
                wanted = problems(panda(), RobotSpheres(panda()), ideal, truth, settings.problems, clearance=clearance)
                audit_mapped(
                    results, name, mapped, truth, wanted, own, seeds=settings.seeds, budget_ms=CONSTANTS.fast_ms
                )
                settings.save(results)
        for run in settings.run:
            report_progress(f"planning in {run}")
            plan_in_run(
                results, run, problems=settings.run_problems, budget_ms=CONSTANTS.fast_ms, margins=settings.margins
            )
            settings.save(results)
    return results


def run_budget(
    settings: PlanningSettings,
    results: Results,
    planner: GaussianRRTStar,
    truth: Truth,
    wanted: Sequence[Problem],
    budget: float,
) -> Array:
    """Plan all problems with one budget; return costs (P,) of the first seed, NaN if unsolved.

    The spread of the mean cost is one standard deviation between the seeds.
    """
    case = f"budget {budget:g} ms"
    seeds = settings.seeds if budget <= 100.0 else 1
    runs: list[PlanResult] = []
    walls, delays = [], []
    for seed in range(seeds):
        for problem in wanted:
            waited = waited_ms()
            begin = time.perf_counter()
            runs.append(planner.plan(problem.start, problem.goal, budget_ms=budget, seed=seed))
            walls.append(1e3 * (time.perf_counter() - begin))
            delays.append(waited_ms() - waited)
    paths = [run.path for run in runs if run.path is not None]
    results.add(case, "solved", float(len(paths)), f"of {len(runs)}")
    spread(results, case, "time", walls, "ms")
    over = np.asarray(walls) - budget
    results.add(case, "overrun, 99 %", float(np.percentile(over, 99)), "ms")
    results.add(case, "overrun, most", float(over.max()), "ms")
    own = np.maximum(over - delays, 0.0)
    results.add(case, "overrun beyond the wait for a CPU, 99 %", float(np.percentile(own, 99)), "ms")
    costs = np.array([np.nan if run.path is None else run.path.cost for run in runs])
    if paths:
        spread(results, case, "first path", [1e3 * run.first_seconds for run in runs if run], "ms")
        results.add(
            case, "cost of the first path, mean", float(np.mean([run.history[0, 1] for run in runs if run])), "rad"
        )
        of_seeds = np.nanmean(costs.reshape(seeds, -1), axis=1)
        deviation = float(np.nanstd(of_seeds, ddof=1)) if seeds > 1 else None
        results.add(case, "cost, mean", float(np.nanmean(costs)), "rad", spread=deviation)
        results.add(case, "uncertified paths", float(sum(not path.certificate.certified for path in paths)), "paths")
        promised = [path.certificate.clearance for path in paths]
        results.add(case, "certified clearance, median", 1e3 * float(np.median(promised)), "mm")
        add_audit(results, case, [path.waypoints for path in paths], planner.arm, truth, promised)
    return costs[: len(wanted)]


def add_audit(
    results: Results,
    case: str,
    paths: Sequence[Array],
    arm: RobotSpheres,
    truth: Truth,
    promised: Sequence[float] | None = None,
    *,
    peer: str | None = None,
) -> None:
    """Add the number of paths in collision with the true shapes or in self-collision, and the penetration."""
    clearances, in_self_collision = audit(paths, arm, truth)
    results.add(case, "in contact with the true shapes", float((clearances <= 0).sum()), f"of {len(paths)}", peer=peer)
    results.add(case, "deepest", 1e3 * max(0.0, -float(clearances.min())), "mm", peer=peer)
    results.add(case, "in self-collision", float(in_self_collision), f"of {len(paths)}", peer=peer)
    if promised is not None:
        broken = int((clearances < np.minimum(promised, CONSTANTS.exact_clearance)).sum())
        results.add(case, "true clearance below the certified one", float(broken), f"of {len(paths)}", peer=peer)


def run_changes(settings: PlanningSettings, results: Results, model: GaussianModel, wanted: Sequence[Problem]) -> None:
    """Measure the update of a path when 500 Gaussians are added, far from it and at its centre.

    A change at the centre counts only if start and goal stay free and the problem can be solved again in time.
    """
    before = GaussianCollisionField(model)
    far = changed(before, model, np.array([-0.6, 0.0, 0.05]))
    kept, repaired = [], []
    valid = solvable = 0
    for seed, problem in enumerate(wanted):
        replanner = Replanner(GaussianRRTStar(before, panda()))
        path = replanner.plan(problem.start, problem.goal, budget_ms=CONSTANTS.fast_ms, seed=seed).path
        if path is None:
            continue
        update = replanner.update(far)
        valid += update.kept
        kept.append(1e3 * update.seconds)
        arm = replanner.planner.arm
        near = changed(far, model, arm.centers(path.at([0.5]))[0, arm.spheres.link >= 6][-1])
        if not GaussianRRTStar(near, panda()).plan(problem.start, problem.goal, budget_ms=CONSTANTS.solvable_ms).path:
            continue
        solvable += 1
        update = replanner.update(near, budget_ms=CONSTANTS.repair_ms)
        if update.result:
            repaired.append(1e3 * (update.seconds - update.result.seconds + update.result.first_seconds))
    results.add(FAR_CHANGE, "paths that stay valid", float(valid), f"of {len(kept)}")
    spread(results, FAR_CHANGE, "certified again", kept, "ms")
    results.add(NEAR_CHANGE, f"repaired in {CONSTANTS.repair_ms:g} ms", float(len(repaired)), f"of {solvable}")
    if repaired:
        spread(results, NEAR_CHANGE, "time to a new path", repaired, "ms")


def changed(before: GaussianCollisionField, model: GaussianModel, at: Array) -> GaussianCollisionField:
    """Add 500 Gaussians within 4 cm of a position (3,) [m] to the field of ``model``."""
    rng = np.random.default_rng(0)
    part = model.select(torch.from_numpy(rng.integers(0, len(model), 500)))
    part.means[:] = torch.from_numpy(at + rng.uniform(-0.04, 0.04, (500, 3))).float()
    later = GaussianModel.concatenate([model, part])
    return before.updated(later, np.arange(len(later)) >= len(model))


def waited_ms() -> float:
    """Return the time [ms] that this thread has waited for a CPU; 0 if the system does not report it."""
    file = Path("/proc/thread-self/schedstat")
    return 1e-6 * int(file.read_text().split()[1]) if file.exists() else 0.0


def add_memory(results: Results, model: GaussianModel, planner: GaussianRRTStar) -> None:
    """Add the memory of a map, its field, and the tree of the planner."""
    case = f"{MEMORY}, {len(model):,} Gaussians"
    field_ = GaussianCollisionField(model)
    parts = {"Gaussians": model.nbytes, "field": field_.nbytes, "tree after the longest budget": planner.nbytes}
    for name, size in parts.items():
        results.add(case, name, size / 1e6, "MB")
    results.add(case, "together", sum(parts.values()) / 1e6, "MB")


def spread(
    results: Results, case: str, metric: str, values: Sequence[float], unit: str, *, peer: str | None = None
) -> None:
    """Add the median and the 95 % quantile of the values."""
    results.add(case, f"{metric}, median", float(np.median(values)), unit, peer=peer)
    results.add(case, f"{metric}, 95 %", float(np.percentile(values, 95)), unit, peer=peer)

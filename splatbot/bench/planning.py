"""`splatbot bench planning`: paths over time budgets, looked at by exact truth, after map changes, beside peers."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import torch

from splatbot.bench.machine import describe_machine
from splatbot.bench.planning_audit import audit
from splatbot.bench.planning_log import map_film, shoot
from splatbot.bench.planning_mapped import add_map, audit_mapped
from splatbot.bench.planning_peers import run_peers
from splatbot.bench.planning_plots import plot_cost
from splatbot.bench.planning_problems import ROOM, Problem, problems
from splatbot.bench.planning_runs import plan_in_run
from splatbot.bench.results import Results
from splatbot.bench.tabletop import tabletop
from splatbot.bench.timing import threads
from splatbot.bench.truth import Truth
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.gaussians import GaussianModel
from splatbot.planning import GaussianRRTStar, PlanResult, Replanner
from splatbot.protocols import Array
from splatbot.robots.panda import panda

Say = Callable[[str], None]
EXACT_TO = 0.01  # [m]; more true room than this is known from below alone
FAST_MS = 28.0  # of the path that a change of the map meets, and of those on mapped logs
REPAIR_MS = 9.0
WIDE = 0.03  # [m] of true room at both ends, so that a margin of 2 cm leaves them free on a map too
SOLVABLE_MS = 100.0  # in which a problem must be solved anew to count as one that can be


@dataclass(frozen=True)
class PlanningPlan:
    """What to run.

    Args:
        gaussians: of the map.
        problems: how many.
        seeds: of each problem, for budgets up to 100 ms; longer ones are run once.
        budgets_ms: of the planner.
        peers: measure other planners and maps too.
        peers_ms: budgets of those that improve until time is up.
        film: (frames, width [px]) of the noisy film that is mapped for :func:`run_mapped`.
        run_problems: in each run's map.
        quick: tiny: whether it runs, not how well.
        say: told what goes on.
    """

    gaussians: int = 50_000
    problems: int = 50
    seeds: int = 10
    budgets_ms: tuple[float, ...] = (1.0, 3.0, 10.0, 28.0, 100.0, 1000.0)
    peers: bool = False
    peers_ms: tuple[float, ...] = (28.0, 100.0, 1000.0)
    film: tuple[int, int] = (120, 320)
    run_problems: int = 10
    quick: bool = False
    say: Say = field(default=lambda text: None)

    @property
    def weighed(self) -> int:
        """Gaussians of the map whose memory is told."""
        return self.gaussians if self.quick else 150_000

    @classmethod
    def quick_plan(cls, *, peers: bool = False, say: Say = lambda text: None) -> PlanningPlan:
        """A run of seconds."""
        return cls(5000, 3, 2, (28.0, 100.0), peers, (28.0,), (24, 160), 2, True, say)


def run_planning(plan: PlanningPlan, out: Path) -> Results:
    """Run the plan on one thread; write planning.json (after each part), planning.csv and the plot into ``out``."""
    plan.say("measuring the machine")
    results = Results(describe_machine((1,), peak_ms=20.0 if plan.quick else 200.0))
    out.mkdir(parents=True, exist_ok=True)
    scene = tabletop()
    model = scene.gaussians(plan.gaussians)
    with threads(1):
        planner = GaussianRRTStar(GaussianCollisionField(model), panda())
        truth = Truth(scene, 0.1 if plan.quick else 0.02)
        wanted = problems(panda(), planner.arm, planner.field, truth, plan.problems)
        costs: dict[float, Array] = {}
        histories: list[Array] = []
        for budget in plan.budgets_ms:
            plan.say(f"budget {budget:g} ms")
            costs[budget], histories = run_budget(plan, results, planner, truth, wanted, budget)
            results.write_json(out / "planning.json")
        plan.say("maps that change")
        run_changes(plan, results, model, wanted)
        add_memory(results, scene.gaussians(plan.weighed), planner)
        theirs: dict[str, dict[float, Array]] = {}
        if plan.peers:
            theirs = run_peers(results, scene, planner, wanted, plan.peers_ms, costs, audit, truth, plan.say)
    results.write_json(out / "planning.json")
    results.write_csv(out / "planning.csv")
    plot_cost(histories, theirs, out)
    return results


def run_mapped(plan: PlanningPlan, out: Path, *, noisy: bool, runs: Sequence[Path] = ()) -> Results:
    """The problems on a map made of a noisy film (``noisy``), and problems in the maps of runs; one thread.

    Writes planning-mapped.json (after each part) and planning-mapped.csv into ``out``.

    Raises:
        FormatError: a run is damaged.
        LogError: the log of a run is gone.
        InputError: there is nowhere to place an arm in a run's map.
    """
    plan.say("measuring the machine")
    results = Results(describe_machine((1,), peak_ms=20.0 if plan.quick else 200.0))
    out.mkdir(parents=True, exist_ok=True)
    with threads(1):
        if noisy:
            scene = tabletop()
            plan.say(f"filming and mapping {plan.film[0]} frames")
            mapped = map_film(shoot(scene, *plan.film))
            truth = Truth(scene, 0.1 if plan.quick else 0.02)
            ideal = GaussianCollisionField(scene.gaussians(plan.gaussians))
            own = add_map(results, mapped)
            for room in (ROOM,) if plan.quick else (ROOM, WIDE):  # a coarse truth knows of little wide room
                name = f"ends with {1e3 * room:g} mm on a mapped noisy log"
                plan.say(name)
                wanted = problems(panda(), RobotSpheres(panda()), ideal, truth, plan.problems, room=room)
                audit_mapped(results, name, mapped, truth, wanted, own, seeds=plan.seeds, budget_ms=FAST_MS)
                results.write_json(out / "planning-mapped.json")
        for run in runs:
            plan.say(f"planning in {run}")
            plan_in_run(results, run, problems=plan.run_problems, budget_ms=FAST_MS)
            results.write_json(out / "planning-mapped.json")
    results.write_csv(out / "planning-mapped.csv")
    return results


def run_budget(
    plan: PlanningPlan,
    results: Results,
    planner: GaussianRRTStar,
    truth: Truth,
    wanted: Sequence[Problem],
    budget: float,
) -> tuple[Array, list[Array]]:
    """All problems at one budget; the costs (P,) of the first seed, NaN where unsolved, and its histories."""
    case = f"budget {budget:g} ms"
    seeds = plan.seeds if budget <= 100.0 else 1
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
        results.add(case, "cost, mean", float(np.nanmean(costs)), "rad")
        results.add(case, "uncertified paths", float(sum(not path.certificate.certified for path in paths)), "paths")
        promised = [path.certificate.clearance for path in paths]
        results.add(case, "clearance promised, median", 1e3 * float(np.median(promised)), "mm")
        add_audit(results, case, [path.waypoints for path in paths], planner.arm, truth, promised)
    return costs[: len(wanted)], [run.history for run in runs[: len(wanted)] if run]


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
    """How many of the paths touch the true shapes or the arm itself, and how deep."""
    rooms, touching_self = audit(paths, arm, truth)
    results.add(case, "touch the truth", float((rooms <= 0).sum()), f"of {len(paths)}", peer=peer)
    results.add(case, "deepest", 1e3 * max(0.0, -float(rooms.min())), "mm", peer=peer)
    results.add(case, "touch themselves", float(touching_self), f"of {len(paths)}", peer=peer)
    if promised is not None:
        broken = int((rooms < np.minimum(promised, EXACT_TO)).sum())
        results.add(case, "nearer to the truth than promised", float(broken), f"of {len(paths)}", peer=peer)


def run_changes(plan: PlanningPlan, results: Results, model: GaussianModel, wanted: Sequence[Problem]) -> None:
    """A path in force when 500 Gaussians come: far from it, and in its middle.

    Only such of the latter count as leave the start and the goal free and can be solved anew in time.
    """
    before = GaussianCollisionField(model)
    far = changed(before, model, np.array([-0.6, 0.0, 0.05]))
    kept, repaired = [], []
    stood = asked = 0
    for seed, problem in enumerate(wanted):
        replanner = Replanner(GaussianRRTStar(before, panda()))
        path = replanner.plan(problem.start, problem.goal, budget_ms=FAST_MS, seed=seed).path
        if path is None:
            continue
        update = replanner.update(far)
        stood += update.kept
        kept.append(1e3 * update.seconds)
        arm = replanner.planner.arm
        near = changed(far, model, arm.centers(path.at([0.5]))[0, arm.spheres.link >= 6][-1])
        if not GaussianRRTStar(near, panda()).plan(problem.start, problem.goal, budget_ms=SOLVABLE_MS).path:
            continue
        asked += 1
        update = replanner.update(near, budget_ms=REPAIR_MS)
        if update.result:
            repaired.append(1e3 * (update.seconds - update.result.seconds + update.result.first_seconds))
    results.add("a far change", "paths that stand", float(stood), f"of {len(kept)}")
    spread(results, "a far change", "certified again", kept, "ms")
    results.add("a change in the way", f"repaired in {REPAIR_MS:g} ms", float(len(repaired)), f"of {asked}")
    if repaired:
        spread(results, "a change in the way", "until there is a path again", repaired, "ms")


def changed(before: GaussianCollisionField, model: GaussianModel, at: Array) -> GaussianCollisionField:
    """The field with 500 more Gaussians within 4 cm of a place (3,) [m], beside those of ``model``."""
    rng = np.random.default_rng(0)
    part = model.select(torch.from_numpy(rng.integers(0, len(model), 500)))
    part.means[:] = torch.from_numpy(at + rng.uniform(-0.04, 0.04, (500, 3))).float()
    later = GaussianModel.concatenate([model, part])
    return before.updated(later, np.arange(len(later)) >= len(model))


def waited_ms() -> float:
    """How long this thread has waited for a CPU while it could have run [ms]; 0 where the system does not say."""
    file = Path("/proc/thread-self/schedstat")
    return 1e-6 * int(file.read_text().split()[1]) if file.exists() else 0.0


def add_memory(results: Results, model: GaussianModel, planner: GaussianRRTStar) -> None:
    """Bytes of a map, its field, and the tree that the planner has grown."""
    case = f"memory, {len(model):,} Gaussians"
    field_ = GaussianCollisionField(model)
    parts = {"Gaussians": model.nbytes, "field": field_.nbytes, "tree after the longest budget": planner.nbytes}
    for name, size in parts.items():
        results.add(case, name, size / 1e6, "MB")
    results.add(case, "together", sum(parts.values()) / 1e6, "MB")


def spread(
    results: Results, case: str, metric: str, values: Sequence[float], unit: str, *, peer: str | None = None
) -> None:
    """Median and 95 % of the values."""
    results.add(case, f"{metric}, median", float(np.median(values)), unit, peer=peer)
    results.add(case, f"{metric}, 95 %", float(np.percentile(values, 95)), unit, peer=peer)

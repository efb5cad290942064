"""Sim-to-sim: policies on maps of noisy films of tables, evaluated in the twin of the map and in a held-out twin."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from splatbot.bench.film import FilmedMap, map_film, shoot
from splatbot.bench.planning_problems import problems
from splatbot.bench.tabletop import Ball, Block, Can, Solid, Tabletop, tabletop
from splatbot.bench.timing import threads
from splatbot.bench.truth import Truth
from splatbot.bench.twin.paths import truth_scene
from splatbot.collision import GaussianCollisionField, RobotSpheres, surface_error
from splatbot.formats.ply import save_ply
from splatbot.geometry import inverse
from splatbot.protocols import Array
from splatbot.results.margin import CONSTANTS as MARGIN
from splatbot.robots.panda import panda
from splatbot.sim.compare.held_out import HeldOutTwin, Spread, draw
from splatbot.sim.compare.push import PushCase, PushTask, push_policies
from splatbot.sim.compare.reach import ReachCase, ReachTask, reach_policies
from splatbot.sim.compare.trials import TrialResults, join, run_trials
from splatbot.sim.scene import Scene, SceneObject, make_scene
from splatbot.sim.solids import rpy_of
from splatbot.sim.twin import Twin

TASKS = ("reach", "push")


@dataclass(frozen=True)
class SimToSimConstants:
    """Constants of the comparison of twins.

    Args:
        push_distance: [m] length of a push.
        fixed_solids: solids of a table that do not move: its top and the shelf.
        places: [m] positions of the objects.
        jitter: [m] random shift of the positions.
        min_clearance: [m] true clearance at both ends of a reach.
        max_match_distance: [m] distance between the centres of an object and of its mapped counterpart.
        swept_clearance: [m] clearance that a push needs.
        seed_stride: difference between the seeds of tables.
    """

    push_distance: float = 0.10
    fixed_solids: int = 5
    places: tuple[tuple[float, float], ...] = ((0.42, -0.42), (0.66, -0.42), (0.42, -0.14), (0.68, -0.14), (0.45, 0.14))
    jitter: float = 0.03
    min_clearance: float = 0.01
    max_match_distance: float = 0.05
    swept_clearance: float = 0.09
    seed_stride: int = 7919


CONSTANTS = SimToSimConstants()


Tell = Callable[[str, float], None]


@dataclass(frozen=True)
class SimToSimPlan:
    """Workload of the comparison.

    Args:
        tasks: Names of :data:`TASKS`.
        tables: Number of different tables, each filmed and mapped.
        trials: Trials of each task on each table. Pushes take the five objects of a table in turns.
        film: Number of frames, and their width [px].
        gaussians: Gaussians of the ideal map that selects the reaches.
        seed: Seed of tables, problems and physics.
    """

    tasks: tuple[str, ...] = TASKS
    tables: int = 2
    trials: int = 10
    film: tuple[int, int] = (120, 320)
    gaussians: int = 20_000
    seed: int = 0


@dataclass(frozen=True, eq=False)
class MappedTable:
    """A table and its map.

    Args:
        table: The true shapes, in the frame of the arm's base.
        mapped: The map of its film.
        file: File of the map.
        seed: Seed of this table.
    """

    table: Tabletop
    mapped: FilmedMap
    file: Path
    seed: int

    def map_scene(self, *, movable: bool) -> Scene:
        """Return the twin's scene of the map, in the frame of the arm's base."""
        T = inverse(self.mapped.T_map_scene)
        place = {"at": T[:3, 3].tolist(), "rpy": rpy_of(T[:3, :3])}
        return make_scene({"name": "map", "map": {"file": str(self.file.resolve()), "movable": movable, **place}})

    def own_margin(self, field: GaussianCollisionField) -> float:
        """Return the error [m] of the map's surfaces near the arm, measured against its own depth images."""
        around = [*self.mapped.T_map_scene[:3, 3], MARGIN.radius]
        return surface_error(field, self.mapped.views(), around=around).share(MARGIN.confidence)


def run_sim_to_sim(plan: SimToSimPlan, folder: Path, tell: Tell = lambda what, share: None) -> tuple[TrialResults, ...]:
    """Run all tasks on all tables, and return one result for each task. Ctrl-C returns the finished trials.

    Maps are written into ``folder``.
    """
    found: dict[str, TrialResults] = {}
    stopped = False
    with threads(1):
        try:
            for number in range(plan.tables):
                tell(f"filming and mapping table {number + 1} of {plan.tables}", 0.0)
                place = map_table(plan, folder / f"map-{number}.ply", plan.seed + CONSTANTS.seed_stride * number)
                for task in plan.tasks:
                    more = _TRY[task](plan, place, tell)
                    found[task] = join(found[task], more) if task in found else more
                    if more.interrupted:
                        raise KeyboardInterrupt
        except KeyboardInterrupt:
            stopped = True
    return tuple(replace(one, interrupted=stopped) for one in found.values())


def map_table(plan: SimToSimPlan, file: Path, seed: int) -> MappedTable:
    """Render a noisy film of the table of that seed, and map it without its poses."""
    table = work_table(seed)
    mapped = map_film(shoot(table, *plan.film, seed=seed))
    file.parent.mkdir(parents=True, exist_ok=True)
    save_ply(
        mapped.snapshot.model, file, bookkeeping=True
    )  # bookkeeping removes unsupported Gaussians from physics as well
    return MappedTable(table, mapped, file, seed)


def work_table(seed: int = 0) -> Tabletop:
    """Return the planner's table with its shelf and five objects to push; the seed varies sizes and positions."""
    rng = np.random.default_rng(seed)
    objects: list[Solid] = []
    for k, place in enumerate(CONSTANTS.places):
        x, y = (np.asarray(place) + rng.uniform(-CONSTANTS.jitter, CONSTANTS.jitter, 2)).tolist()
        if k % 2:
            objects.append(Can((x, y, 0.0), float(rng.uniform(0.035, 0.05)), float(rng.uniform(0.08, 0.15))))
        else:
            width, depth, height = rng.uniform([0.06, 0.06, 0.08], [0.10, 0.10, 0.15]).tolist()
            objects.append(Block((x, y, height / 2), (width, depth, height), float(rng.uniform(-1.5, 1.5))))
    return Tabletop((*tabletop().solids[: CONSTANTS.fixed_solids], *objects))


def _reach(plan: SimToSimPlan, place: MappedTable, tell: Tell) -> TrialResults:
    robot, field = panda(), GaussianCollisionField(place.mapped.snapshot)
    ideal = GaussianCollisionField(place.table.gaussians(plan.gaussians))
    truth = Truth(place.table, 0.05)
    wanted = problems(robot, RobotSpheres(robot), ideal, truth, plan.trials, place.seed, CONSTANTS.min_clearance)
    cases = [ReachCase(problem.start, problem.goal, place.seed + k) for k, problem in enumerate(wanted)]
    true = truth_scene(place.table)
    task = ReachTask(
        cases, Twin(place.map_scene(movable=False)), lambda case: HeldOutTwin(true, draw(Spread(), case.seed))
    )
    policies = reach_policies(field, robot, place.mapped.T_map_scene, place.own_margin(field))
    return run_trials(task, policies, seed=plan.seed, on_progress=tell)


def _push(plan: SimToSimPlan, place: MappedTable, tell: Tell) -> TrialResults:
    map_twin = Twin(place.map_scene(movable=True))
    mapped = [found for found in map_twin.world.scene.objects if found.movable]
    true = movable_truth(place.table)
    rng = np.random.default_rng(place.seed)
    cases = []
    for k in range(plan.trials):
        index = CONSTANTS.fixed_solids + k % len(CONSTANTS.places)
        direction = _free_direction(place.table, index, rng)
        match = _mapped_object(mapped, middle_of(place.table.solids[index]))
        cases.append(PushCase(match, f"thing{index}", direction, CONSTANTS.push_distance, place.seed + k))
    task = PushTask(cases, map_twin, lambda case: HeldOutTwin(true, draw(Spread(), case.seed)))
    return run_trials(task, push_policies(panda()), seed=plan.seed, on_progress=tell)


_TRY = {"reach": _reach, "push": _push}


def movable_truth(table: Tabletop) -> Scene:
    """Return the scene of the true shapes, in which the objects on the table are movable."""
    scene = truth_scene(table)
    objects = [
        shape.model_copy(update={"movable": k >= CONSTANTS.fixed_solids}) for k, shape in enumerate(scene.objects)
    ]
    return make_scene({**scene.model_dump(), "objects": objects})


def middle_of(solid: Solid) -> Array:
    """Return the centre of a solid (3,) [m]."""
    if isinstance(solid, Can):
        x, y, z = solid.foot
        return np.array([x, y, z + solid.height / 2])
    assert isinstance(solid, Block | Ball)
    return np.asarray(solid.center, dtype=np.float64)


def _mapped_object(candidates: Sequence[SceneObject], center: Array) -> SceneObject | None:
    """Return the mapped object at the position of a true one; policies do not know this association."""
    gaps = [float(np.linalg.norm(np.asarray(found.at)[:2] - center[:2])) for found in candidates]
    return candidates[int(np.argmin(gaps))] if gaps and min(gaps) <= CONSTANTS.max_match_distance else None


def _free_direction(table: Tabletop, index: int, rng: np.random.Generator) -> Array:
    """Choose a direction (2,) with enough clearance for the object and the hand behind it, or the one with the most."""
    rest = Tabletop(tuple(solid for k, solid in enumerate(table.solids) if k not in (0, index)))
    middle = middle_of(table.solids[index])
    angles = np.linspace(-np.pi / 2, np.pi / 2, 8) + rng.uniform(0.0, np.pi / 8)  # away from the arm
    directions = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    along = np.linspace(-0.12, CONSTANTS.push_distance + 0.05, 12)[:, None]
    clearances = []
    for direction in directions:
        points = np.c_[middle[:2] + along * direction, np.full(len(along), 0.1)]
        on_table = bool(
            (np.abs(points[:, 1]) < 0.7).all() and (points[:, 0] > 0.28).all() and (points[:, 0] < 0.85).all()
        )
        clearances.append(float(rest.distance(points).min()) if on_table else -1.0)
    good = np.flatnonzero(np.array(clearances) > CONSTANTS.swept_clearance)
    return np.asarray(directions[rng.choice(good) if len(good) else int(np.argmax(clearances))])

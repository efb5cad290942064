"""Policies on maps of noisy films of tables, tried in the map's twin and in a held-out one: sim-to-sim."""

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
from splatbot.results.margin import RADIUS, SHARE
from splatbot.robots.panda import panda
from splatbot.sim.compare.held_out import HeldOutTwin, Spread, draw
from splatbot.sim.compare.push import PushCase, PushTask, push_policies
from splatbot.sim.compare.reach import ReachCase, ReachTask, reach_policies
from splatbot.sim.compare.trials import TrialResults, join, run_trials
from splatbot.sim.scene import Scene, SceneObject, make_scene
from splatbot.sim.solids import rpy_of
from splatbot.sim.twin import Twin

TASKS = ("reach", "push")
DISTANCE = 0.10  # [m] that things are pushed
_FIXED = 5  # solids of a table that do not move: its top and the shelf
_PLACES = ((0.42, -0.42), (0.66, -0.42), (0.42, -0.14), (0.68, -0.14), (0.45, 0.14))  # [m] where things stand
_JITTER = 0.03  # [m]
_ROOM = 0.01  # [m] of true room at both ends of a reach
_MATCH = 0.05  # [m] between the middles of a thing and of what the map has of it
_SWEPT = 0.09  # [m] around a push that shall be free
_TABLES = 7919  # between seeds

Tell = Callable[[str, float], None]


@dataclass(frozen=True)
class SimToSimPlan:
    """What to run.

    Args:
        tasks: names of :data:`TASKS`.
        tables: different ones, each filmed and mapped.
        trials: of each task on each table; a table has five things to push, again and again.
        film: frames, and their width [px].
        gaussians: of the ideal map that reaches are chosen by.
        seed: of everything.
    """

    tasks: tuple[str, ...] = TASKS
    tables: int = 2
    trials: int = 10
    film: tuple[int, int] = (120, 320)
    gaussians: int = 20_000
    seed: int = 0


@dataclass(frozen=True, eq=False)
class MappedTable:
    """A table, what was mapped of it, and where the map is.

    Args:
        table: the true shapes, around the arm's base.
        mapped: from its film.
        file: that the map is in.
        seed: of this table.
    """

    table: Tabletop
    mapped: FilmedMap
    file: Path
    seed: int

    def map_scene(self, *, movable: bool) -> Scene:
        """The twin's scene of the map, around the arm's base."""
        T = inverse(self.mapped.T_map_scene)
        place = {"at": T[:3, 3].tolist(), "rpy": rpy_of(T[:3, :3])}
        return make_scene({"name": "map", "map": {"file": str(self.file.resolve()), "movable": movable, **place}})

    def own_margin(self, field: GaussianCollisionField) -> float:
        """The error [m] of the map's surfaces near the arm, as its own depth tells."""
        around = [*self.mapped.T_map_scene[:3, 3], RADIUS]
        return surface_error(field, self.mapped.views(), around=around).share(SHARE)


def run_sim_to_sim(plan: SimToSimPlan, folder: Path, tell: Tell = lambda what, share: None) -> tuple[TrialResults, ...]:
    """All tasks on all tables; one result for each task. Ctrl-C ends it with what was done.

    Maps are written into ``folder``.
    """
    found: dict[str, TrialResults] = {}
    stopped = False
    with threads(1):
        try:
            for number in range(plan.tables):
                tell(f"filming and mapping table {number + 1} of {plan.tables}", 0.0)
                place = map_table(plan, folder / f"map-{number}.ply", plan.seed + _TABLES * number)
                for task in plan.tasks:
                    more = _TRY[task](plan, place, tell)
                    found[task] = join(found[task], more) if task in found else more
                    if more.interrupted:
                        raise KeyboardInterrupt
        except KeyboardInterrupt:
            stopped = True
    return tuple(replace(one, interrupted=stopped) for one in found.values())


def map_table(plan: SimToSimPlan, file: Path, seed: int) -> MappedTable:
    """A table of that seed, filmed with noise and mapped without its poses."""
    table = work_table(seed)
    mapped = map_film(shoot(table, *plan.film, seed=seed))
    file.parent.mkdir(parents=True, exist_ok=True)
    save_ply(mapped.snapshot.model, file, bookkeeping=True)  # what no depth supports is air to physics, too
    return MappedTable(table, mapped, file, seed)


def work_table(seed: int = 0) -> Tabletop:
    """The planner's table with its shelf, and five things with room to push them; sizes and places differ by seed."""
    rng = np.random.default_rng(seed)
    things: list[Solid] = []
    for k, place in enumerate(_PLACES):
        x, y = (np.asarray(place) + rng.uniform(-_JITTER, _JITTER, 2)).tolist()
        if k % 2:
            things.append(Can((x, y, 0.0), float(rng.uniform(0.035, 0.05)), float(rng.uniform(0.08, 0.15))))
        else:
            width, depth, height = rng.uniform([0.06, 0.06, 0.08], [0.10, 0.10, 0.15]).tolist()
            things.append(Block((x, y, height / 2), (width, depth, height), float(rng.uniform(-1.5, 1.5))))
    return Tabletop((*tabletop().solids[:_FIXED], *things))


def _reach(plan: SimToSimPlan, place: MappedTable, tell: Tell) -> TrialResults:
    robot, field = panda(), GaussianCollisionField(place.mapped.snapshot)
    ideal = GaussianCollisionField(place.table.gaussians(plan.gaussians))
    truth = Truth(place.table, 0.05)
    wanted = problems(robot, RobotSpheres(robot), ideal, truth, plan.trials, place.seed, _ROOM)
    cases = [ReachCase(problem.start, problem.goal, place.seed + k) for k, problem in enumerate(wanted)]
    true = truth_scene(place.table)
    task = ReachTask(
        cases, Twin(place.map_scene(movable=False)), lambda case: HeldOutTwin(true, draw(Spread(), case.seed))
    )
    policies = reach_policies(field, robot, place.mapped.T_map_scene, place.own_margin(field))
    return run_trials(task, policies, seed=plan.seed, on_progress=tell)


def _push(plan: SimToSimPlan, place: MappedTable, tell: Tell) -> TrialResults:
    map_twin = Twin(place.map_scene(movable=True))
    believed = [thing for thing in map_twin.world.scene.objects if thing.movable]
    true = movable_truth(place.table)
    rng = np.random.default_rng(place.seed)
    cases = []
    for k in range(plan.trials):
        index = _FIXED + k % len(_PLACES)
        direction = _free_direction(place.table, index, rng)
        match = _believed(believed, middle_of(place.table.solids[index]))
        cases.append(PushCase(match, f"thing{index}", direction, DISTANCE, place.seed + k))
    task = PushTask(cases, map_twin, lambda case: HeldOutTwin(true, draw(Spread(), case.seed)))
    return run_trials(task, push_policies(panda()), seed=plan.seed, on_progress=tell)


_TRY = {"reach": _reach, "push": _push}


def movable_truth(table: Tabletop) -> Scene:
    """The true shapes, things that stand on the table movable."""
    scene = truth_scene(table)
    things = [thing.model_copy(update={"movable": k >= _FIXED}) for k, thing in enumerate(scene.objects)]
    return make_scene({**scene.model_dump(), "objects": things})


def middle_of(solid: Solid) -> Array:
    """Of a solid (3,) [m]."""
    if isinstance(solid, Can):
        x, y, z = solid.foot
        return np.array([x, y, z + solid.height / 2])
    assert isinstance(solid, Block | Ball)
    return np.asarray(solid.center, dtype=np.float64)


def _believed(things: Sequence[SceneObject], middle: Array) -> SceneObject | None:
    """What the map has at a thing's place; the table's maker knows of both, no policy does."""
    gaps = [float(np.linalg.norm(np.asarray(thing.at)[:2] - middle[:2])) for thing in things]
    return things[int(np.argmin(gaps))] if gaps and min(gaps) <= _MATCH else None


def _free_direction(table: Tabletop, index: int, rng: np.random.Generator) -> Array:
    """One of those directions (2,) in which a thing and the hand behind it have room, or the one with most."""
    rest = Tabletop(tuple(solid for k, solid in enumerate(table.solids) if k not in (0, index)))
    middle = middle_of(table.solids[index])
    angles = np.linspace(-np.pi / 2, np.pi / 2, 8) + rng.uniform(0.0, np.pi / 8)  # away from the arm
    ways = np.stack([np.cos(angles), np.sin(angles)], axis=1)
    along = np.linspace(-0.12, DISTANCE + 0.05, 12)[:, None]
    rooms = []
    for way in ways:
        points = np.c_[middle[:2] + along * way, np.full(len(along), 0.1)]
        on_table = bool(
            (np.abs(points[:, 1]) < 0.7).all() and (points[:, 0] > 0.28).all() and (points[:, 0] < 0.85).all()
        )
        rooms.append(float(rest.distance(points).min()) if on_table else -1.0)
    good = np.flatnonzero(np.array(rooms) > _SWEPT)
    return np.asarray(ways[rng.choice(good) if len(good) else int(np.argmax(rooms))])

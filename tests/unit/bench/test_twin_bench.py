"""The benchmark of the twin: its truth is MuJoCo's geometry, its motions keep to limits, pushed paths are seen."""

from __future__ import annotations

import itertools

import mujoco
import numpy as np
import pytest

from splatbot.bench.results import Results
from splatbot.bench.tabletop import tabletop
from splatbot.bench.twin.bounds import FORCED, broken_bounds
from splatbot.bench.twin.paths import CONSTANTS as PATHS
from splatbot.bench.twin.paths import arm_clearance, push, timed, truth_scene, try_paths
from splatbot.robots.panda import panda
from splatbot.sim.twin import Twin


def test_the_closed_form_room_is_that_between_mujocos_geoms(rng: np.random.Generator) -> None:
    """Two computations that share no code; the first looks at 13 points of each axis, and so is a little above."""
    table, twin = tabletop(), Twin(truth_scene(tabletop()))
    world, data = twin.world, twin.data
    arm = [g for g in range(world.model.ngeom) if world.of_robot[g] and world.owner[g] != "link0"]
    rest = np.flatnonzero(~world.of_robot)
    compared = 0
    for q in panda().random(40, rng):
        twin.reset(q)
        theirs = min(mujoco.mj_geomDistance(world.model, data, a, b, 1.0, None) for a in arm for b in rest)
        ours = float(arm_clearance(panda(), table, q[None])[0])
        if 0.0 < theirs < 0.9:
            compared += 1
            assert -1e-6 < ours - theirs < 5e-3
    assert compared > 5


def test_a_timed_path_stays_on_its_edges_and_within_limits(rng: np.random.Generator) -> None:
    chain = panda().chain
    waypoints = panda().random(4, rng)
    motion = timed(waypoints, chain)
    assert (np.abs(motion.velocity) <= chain.velocity).all()
    assert (np.abs(motion.acceleration) <= chain.acceleration).all()
    for q in motion.position[::37]:
        off = []
        for a, b in itertools.pairwise(waypoints):
            share = np.clip((q - a) @ (b - a) / ((b - a) @ (b - a)), 0, 1)
            off.append(float(np.linalg.norm(q - a - share * (b - a))))
        assert min(off) < 1e-9


def test_a_pushed_path_ends_a_centimetre_deep() -> None:
    home = panda().home
    into = push(np.stack([home, home + 0.2]), panda(), tabletop(), PATHS.push_depth)
    assert into is not None
    assert float(arm_clearance(panda(), tabletop(), into[-1:])[0]) <= -PATHS.push_depth
    assert float(arm_clearance(panda(), tabletop(), into[:1])[0]) > 0


@pytest.mark.long
def test_planned_paths_are_free_and_pushed_ones_cause_contacts() -> None:
    trials = try_paths(2, gaussians=6000, budget_ms=60.0)
    assert trials.planned == trials.certified == 2
    assert trials.in_contact == 0
    assert trials.least_clearance > 0
    assert trials.detected == trials.pushed == 2


def test_a_figure_out_of_its_bounds_is_named_and_one_that_is_missing_is_not() -> None:
    results = Results({})
    results.add("empty scene", "over the robot alone", 0.9, "x")
    assert broken_bounds(results) == []
    results.add(FORCED, "over none forced", 1.01, "x")
    assert broken_bounds(results) == [f"{FORCED}: over none forced is 1.01, not in 1.2..inf"]

"""Policies in two twins: differences of the twins, motions of the policies, and storage of results."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from splatbot.bench import sim2sim
from splatbot.bench.sim2sim import middle_of, movable_truth, work_table
from splatbot.bench.tabletop import Block, Can, Tabletop
from splatbot.bench.twin.paths import truth_scene
from splatbot.collision import GaussianCollisionField
from splatbot.errors import InputError
from splatbot.planning import GaussianRRTStar
from splatbot.robots.panda import panda
from splatbot.sim.compare.held_out import HeldOutTwin, Spread, draw, held_out_scene
from splatbot.sim.compare.push import PushCase, Pusher, PushTask, extents
from splatbot.sim.compare.reach import Direct, Planned, ReachCase, ReachTask, Shortcut
from splatbot.sim.compare.trials import PolicyAction, Trial, TrialResults, join, run_trials
from splatbot.sim.effects.physics import PHYSICS
from splatbot.sim.motion import JointMotion, hold, motion_from_samples
from splatbot.sim.scene import Scene, SceneObject, make_scene
from splatbot.sim.twin import Twin, TwinResult

pytest.importorskip("mujoco")

EXACT = Spread((1, 1), (1, 1), (1, 1), (0, 0), (0, 0), (0, 0), (0, 0), 0.0, 0.0)
WALL = Block((0.45, 0.0, 0.35), (0.3, 0.04, 0.7))
START = np.array([-0.6, 0.2, 0.0, -2.0, 0.0, 2.2, 0.785])
GOAL = START * [-1, 1, 1, 1, 1, 1, 1]


@cache
def table() -> Tabletop:
    return Tabletop((Block((0.6, 0.0, -0.02), (0.8, 1.4, 0.04)), WALL))


@cache
def planner() -> GaussianRRTStar:
    return GaussianRRTStar(GaussianCollisionField(table().gaussians(8000)), panda(), margin=0.01)


def _swing(seconds: float = 1.0) -> JointMotion:
    t = np.linspace(0.0, seconds, 51)
    u = t / seconds
    share = u**3 * (10 - 15 * u + 6 * u**2)
    return motion_from_samples(t, panda().home + share[:, None] * np.array([0.6, 0.2, 0, 0.3, 0, 0, 0]))


def test_the_same_seed_draws_the_same_physics_within_its_spread() -> None:
    found = [draw(Spread(), seed) for seed in range(200)]
    assert found[7] == draw(Spread(), 7)
    assert found[7] != found[8]
    for name in ("friction", "mass", "gain", "lag", "latency", "joint_friction", "backlash"):
        low, high = getattr(Spread(), name)
        values = [getattr(one, name) for one in found]
        assert low <= min(values) < low + 0.1 * (high - low)
        assert high - 0.1 * (high - low) < max(values) <= high
    assert np.std([one.base for one in found]) == pytest.approx(0.001, rel=0.15)


def test_a_held_out_scene_has_all_effects_on_and_the_physics_that_was_drawn() -> None:
    scene = movable_truth(work_table(1))
    physics = draw(Spread(), 3)
    other = held_out_scene(scene, physics)
    twin = HeldOutTwin(scene, physics)
    assert set(PHYSICS) <= set(twin.world.on)
    for mine, theirs in zip(scene.objects, other.objects, strict=True):
        assert theirs.friction == pytest.approx(mine.friction * physics.friction)
        assert theirs.mass == (pytest.approx(0.2 * physics.mass) if mine.movable else None)
    assert other.robot is not None
    assert other.robot.motors.lag == physics.lag
    assert other.robot.at == physics.base


def test_without_a_spread_the_held_out_twin_is_the_twin() -> None:
    """Effects that are forced on and act on nothing here move no joint by a hundredth of a milliradian."""
    scene = make_scene({"name": "bare"})
    nominal, held = Twin(scene), HeldOutTwin(scene, draw(EXACT, 0))
    nominal.follow(_swing())
    held.follow(_swing())
    assert nominal.follower is not None
    q = nominal.follower.qpos
    np.testing.assert_allclose(held.data.qpos[q], nominal.data.qpos[q], atol=1e-5)


@pytest.mark.parametrize(("change", "least"), [({"gain": 0.6}, 2e-4), ({"lag": 0.02}, 5e-3), ({"latency": 0.02}, 5e-3)])
def test_each_kind_of_bad_drive_costs_tracking(change: dict[str, Any], least: float) -> None:
    scene = make_scene({"name": "bare"})
    exact = draw(EXACT, 0)
    good, bad = (HeldOutTwin(scene, physics).follow(_swing()) for physics in (exact, replace(exact, **change)))
    assert good.tracking is not None
    assert bad.tracking is not None
    assert bad.tracking.largest > good.tracking.largest + least


def test_a_planned_path_arrives_and_the_straight_line_hits_the_wall() -> None:
    case = ReachCase(START, GOAL, 1)
    twin = Twin(truth_scene(table()))
    task = ReachTask([case], twin, lambda case: HeldOutTwin(truth_scene(table()), draw(Spread(), case.seed)))
    policies = (Planned("planned", planner(), iterations=300), Direct("straight", planner()))
    found = run_trials(task, policies)
    planned, straight = found.trials
    assert planned.in_map
    assert planned.in_held_out
    assert planned.promised is not None
    assert planned.promised >= 0.01
    assert not straight.in_map
    assert not straight.in_held_out
    assert "with thing1" in straight.why_held_out
    assert straight.promised is None


def test_equal_cases_get_equal_motions() -> None:
    case = ReachCase(START, GOAL, 4)
    for policy in (Planned("p", planner(), iterations=200), Shortcut("s", planner(), 8, iterations=200)):
        first, again = policy.act(case), policy.act(case)
        assert first is not None
        assert again is not None
        np.testing.assert_array_equal(first.motion.position, again.motion.position)


def test_shortcuts_are_shorter_and_promise_nothing() -> None:
    case = ReachCase(START, GOAL, 2)
    policies = Planned("p", planner(), iterations=200), Shortcut("s", planner(), 2, iterations=200)
    plain, cut = (policy.act(case) for policy in policies)
    assert plain is not None
    assert cut is not None
    assert cut.promised is None
    lengths = [np.linalg.norm(np.diff(a.motion.position, axis=0), axis=1).sum() for a in (plain, cut)]
    assert lengths[1] < lengths[0]


def test_a_start_within_the_wall_is_refused() -> None:
    inside = panda().home.copy()
    found = Planned("p", planner()).act(ReachCase(inside * [0, 1, 1, 1, 1, 1, 1], GOAL))
    assert found is None


def _can(height: float, friction: float = 0.5) -> Scene:
    can = {"kind": "cylinder", "radius": 0.04, "height": height}
    items = [
        {"name": "table", "shapes": [{"kind": "plane"}]},
        {"name": "can", "shapes": [can], "at": [0.5, 0.0, height / 2], "movable": True, "friction": friction},
    ]
    return make_scene({"name": "push", "objects": items})


def test_a_low_slow_push_brings_a_can_to_its_goal_and_an_aimless_one_does_not() -> None:
    scene = _can(0.10)
    case = PushCase(scene.objects[1], "can", np.array([1.0, 0.0]), 0.10)
    task = PushTask([case], Twin(scene), lambda case: HeldOutTwin(scene, draw(EXACT, 0)))
    policies = (Pusher("good", panda(), 0.35, 0.08), Pusher("offset", panda(), 0.35, 0.08, 0.09))
    good, offset = run_trials(task, policies).trials
    assert (good.in_map, good.in_held_out) == (True, True), good
    assert (offset.in_map, offset.in_held_out) == (False, False)
    assert "short" in offset.why_held_out


def test_what_the_map_lacks_is_not_pushed() -> None:
    case = PushCase(None, "can", np.array([1.0, 0.0]), 0.1)
    assert Pusher("any", panda(), 0.35, 0.08).act(case) is None


@pytest.mark.parametrize(
    ("shape", "back", "top"),
    [
        ({"kind": "box", "size": [0.2, 0.1, 0.3]}, 0.1, 0.15),
        ({"kind": "box", "size": [0.2, 0.1, 0.3], "rpy": [0, 0, np.pi / 2]}, 0.05, 0.15),
        ({"kind": "sphere", "radius": 0.07, "at": [0.01, 0, 0]}, 0.06, 0.07),
        ({"kind": "cylinder", "radius": 0.03, "height": 0.2}, 0.03, 0.1),
        ({"kind": "ellipsoid", "axes": [0.1, 0.2, 0.3]}, 0.1, 0.3),
        ({"kind": "mesh", "points": [[-0.2, 0, 0], [0.3, 0, 0], [0, 1, 0], [0, 0, 0.4]]}, 0.2, 0.4),
    ],
)
def test_extents_of_shapes_are_their_support_functions(shape: dict[str, object], back: float, top: float) -> None:
    item = SceneObject.model_validate({"name": "a", "shapes": [shape], "at": [0, 0, 0.5]})
    assert extents(item, np.array([1.0, 0.0, 0.0])) == pytest.approx((back, 0.5 + top))


def test_work_tables_differ_by_seed_and_their_things_stand_apart() -> None:
    first, again, other = (work_table(seed) for seed in (0, 0, 1))
    assert first == again
    assert first != other
    for one in (first, other):
        items = one.solids[5:]
        for k, item in enumerate(items):
            assert isinstance(item, Block | Can)
            rest = Tabletop(tuple(t for i, t in enumerate(items) if i != k))
            assert rest.distance(middle_of(item)[None])[0] > 0.08


@dataclass(frozen=True)
class _Still:
    """Nothing moves; a table defines which trials succeed."""

    success: tuple[bool, ...]
    name: str = "still"
    break_at: int = 99

    @property
    def cases(self) -> Sequence[int]:
        return range(len(self.success))

    def twins(self, case: int) -> tuple[Twin, Twin]:
        if case == self.break_at:
            raise KeyboardInterrupt
        return Twin(make_scene({"name": "bare"})), Twin(make_scene({"name": "bare"}))

    def failure(self, case: int, twin: Twin, result: TwinResult) -> str:
        return "" if self.success[case] else "failed"


@dataclass(frozen=True)
class _Waits:
    name: str
    refuses: bool = False

    def act(self, case: int) -> PolicyAction | None:
        return None if self.refuses else PolicyAction(hold(panda().home, 0.01), 0.02)


def test_every_policy_is_tried_in_every_case_and_the_result_is_json() -> None:
    found = run_trials(_Still((True, False, True)), [_Waits("a"), _Waits("b", refuses=True)])
    assert [(t.policy, t.case, t.in_map) for t in found.trials if t.policy == "a"] == [
        ("a", 0, True),
        ("a", 1, False),
        ("a", 2, True),
    ]
    agreed = found.agreement()
    assert agreed is not None
    assert [p.refused for p in agreed.policies] == [0, 3]
    values = json.loads(json.dumps(found.to_dict(), allow_nan=False))
    assert values["kind"] == "sim-to-sim"
    assert values["reliability"][0]["count"] == 3
    assert values["agreement"]["policies"][0]["in_map"]["value"] == pytest.approx(2 / 3)


def test_a_stop_keeps_the_cases_that_are_whole_and_says_so() -> None:
    found = run_trials(_Still((True, True, True), break_at=2), [_Waits("a")])
    assert found.interrupted
    assert found.cases == (0, 1)
    assert run_trials(_Still((True,), break_at=0), [_Waits("a")]).agreement() is None


def test_policies_have_names_of_their_own() -> None:
    with pytest.raises(InputError, match="a, a"):
        run_trials(_Still((True,)), [_Waits("a"), _Waits("a")])


def test_results_of_two_tables_are_those_of_one_task() -> None:
    a = TrialResults("t", ("p",), (Trial("p", 0, False, True, True), Trial("p", 1, False, True, False)))
    b = TrialResults("t", ("p",), (Trial("p", 0, False, False, False),), interrupted=True)
    both = join(a, b)
    assert both.cases == (0, 1, 2)
    assert both.interrupted
    agreed = both.agreement()
    assert agreed is not None
    assert agreed.policies[0].in_map.value == pytest.approx(2 / 3)
    with pytest.raises(InputError):
        join(a, TrialResults("t", ("q",), ()))


def test_a_stop_while_a_table_is_mapped_keeps_the_tables_before_it(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    whole = run_trials(_Still((True, False)), [_Waits("a")])
    mapped: list[int] = []

    def map_one(plan: sim2sim.SimToSimPlan, file: Path, seed: int) -> None:
        if len(mapped) == 2:
            raise KeyboardInterrupt
        mapped.append(seed)

    monkeypatch.setattr(sim2sim, "map_table", map_one)
    monkeypatch.setattr(sim2sim, "_TRY", {"reach": lambda plan, place, on_progress: whole})
    (found,) = sim2sim.run_sim_to_sim(sim2sim.SimToSimPlan(("reach",), tables=5), tmp_path)
    assert found.interrupted
    assert found.cases == (0, 1, 2, 3)
    assert len(set(mapped)) == 2

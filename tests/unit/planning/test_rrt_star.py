"""The planner against known optima; guarantees of its tree, its paths and its time."""

from __future__ import annotations

import threading

import numpy as np
import pytest

import splatbot
from splatbot._native import set_num_threads
from splatbot.collision import GaussianCollisionField
from splatbot.errors import InputError
from splatbot.planning import GaussianRRTStar, GoalError, PlanningError, PlanningProblem, PlanStatus, StartError
from splatbot.protocols import Array
from splatbot.robots.panda import panda
from tests.unit.planning.toys import Slider, around_the_ball, ball_world, cause_of
from tests.waiting import until

# Two places of the hand close above the table, with objects between them.
LEFT = np.array([-0.26, 0.79, 1.15, -2.5, 0.29, 3.06, -2.15])
RIGHT = np.array([-1.95, 1.04, 0.61, -1.56, 0.78, 2.11, -0.97])


@pytest.fixture(scope="module")
def ball() -> GaussianCollisionField:
    """A ball at the origin."""
    return GaussianCollisionField(ball_world())


@pytest.fixture
def planner(field: GaussianCollisionField) -> GaussianRRTStar:
    """The Panda before the table."""
    return GaussianRRTStar(field, panda())


def _length(waypoints: Array) -> float:
    return float(np.linalg.norm(np.diff(waypoints, axis=0), axis=1).sum())


def test_the_planner_is_a_public_name() -> None:
    assert splatbot.GaussianRRTStar is GaussianRRTStar


@pytest.mark.parametrize("joints", [2, 7])
def test_paths_come_within_two_percent_of_the_known_shortest(ball: GaussianCollisionField, joints: int) -> None:
    start, goal = np.full(joints, -0.3), np.full(joints, 0.3)
    start[:2], goal[:2] = [-0.8, 0.0], [0.8, 0.0]
    rest = _length(np.stack([start, goal])[:, 2:])  # joints that collide with nothing move evenly along the way
    shortest = np.hypot(around_the_ball(0.8), rest)
    result = GaussianRRTStar(ball, Slider(joints)).plan(start, goal, budget_ms=60_000, iterations=4000)
    assert shortest * (1 - 1e-9) < result.unwrap().cost < 1.02 * shortest


def test_rewiring_leads_nearly_straight_to_what_the_start_can_see(ball: GaussianCollisionField) -> None:
    planner = GaussianRRTStar(ball, Slider(2))
    planner.plan([-0.8, 0.0], [0.8, 0.0], budget_ms=60_000, iterations=4000)
    q, _, cost = planner.tree()
    seen = ~planner.arm.certify(planner.field, np.tile(q[0], (len(q), 1)), q).in_collision
    straight = np.linalg.norm(q - q[0], axis=1)
    seen &= straight > 0
    assert seen.sum() > 50
    assert (cost >= straight * (1 - 1e-12)).all()
    assert np.median(cost[seen] / straight[seen]) < 1.01
    assert (cost[seen] < 1.3 * straight[seen]).all()


def test_every_node_costs_what_its_edges_add_up_to_and_no_way_runs_in_a_circle(planner: GaussianRRTStar) -> None:
    result = planner.plan(LEFT, RIGHT, budget_ms=60_000, iterations=2000)
    q, parent, cost = planner.tree()
    assert len(q) == result.nodes > 50
    assert parent[0] == -1
    assert (parent[1:] >= 0).all()
    assert cost[0] == 0.0
    np.testing.assert_array_equal(q[0], LEFT)
    edges = np.linalg.norm(q[1:] - q[parent[1:]], axis=1)
    np.testing.assert_allclose(cost[1:], cost[parent[1:]] + edges, rtol=1e-12)
    above = parent.copy()
    for _ in range(len(q)):
        above = np.where(above > 0, parent[above], above)
    assert (above <= 0).all()


def test_every_edge_of_the_tree_is_certified(planner: GaussianRRTStar) -> None:
    planner.plan(LEFT, RIGHT, budget_ms=60_000, iterations=2000)
    q, parent, _ = planner.tree()
    for a, b in ((q[parent[1:]], q[1:]), (q[1:], q[parent[1:]])):
        assert not planner.arm.certify(planner.field, a, b, eps=planner.eps / 2).in_collision.any()


def test_a_path_is_free_between_its_waypoints_and_its_cost_is_its_length(planner: GaussianRRTStar) -> None:
    result = planner.plan(LEFT, RIGHT, budget_ms=60_000, iterations=2000)
    path = result.unwrap()
    np.testing.assert_array_equal(path.waypoints[[0, -1]], [LEFT, RIGHT])
    assert path.cost == pytest.approx(_length(path.waypoints), rel=1e-12)
    assert path.certificate.certified
    assert path.certificate.map_version == planner.field.map_version
    along = path.at(np.linspace(0, 1, 4001))
    assert not planner.arm.check(planner.field, along).in_collision.any()
    clearance = planner.arm.clearance(planner.field, along, cut=0.2).distance.min()
    assert 0.0 <= path.certificate.clearance <= clearance < path.certificate.clearance + 2e-3


def test_better_paths_come_one_after_the_other(planner: GaussianRRTStar) -> None:
    result = planner.plan(LEFT, RIGHT, budget_ms=60_000, iterations=2000)
    seconds, cost = result.history.T
    assert (np.diff(seconds) >= 0).all()
    assert (np.diff(cost) < 0).all()
    assert cost[-1] == result.unwrap().cost
    assert seconds[-1] <= result.seconds


def test_a_seed_and_a_number_of_iterations_give_one_path_on_any_number_of_threads(
    field: GaussianCollisionField,
) -> None:
    found = []
    for threads in (1, 2, 2):
        set_num_threads(threads)
        result = GaussianRRTStar(field, panda()).plan(LEFT, RIGHT, budget_ms=60_000, iterations=500, seed=3)
        found.append(result.unwrap().waypoints)
    set_num_threads(0)
    other = GaussianRRTStar(field, panda()).plan(LEFT, RIGHT, budget_ms=60_000, iterations=500, seed=4)
    np.testing.assert_array_equal(found[0], found[1])
    np.testing.assert_array_equal(found[0], found[2])
    assert not np.array_equal(found[0], other.unwrap().waypoints)


def test_a_problem_is_solved_as_its_start_and_goal_are(planner: GaussianRRTStar) -> None:
    one = planner.solve(PlanningProblem(LEFT, RIGHT), budget_ms=60_000, iterations=200, seed=5).unwrap()
    other = planner.plan(LEFT, RIGHT, budget_ms=60_000, iterations=200, seed=5).unwrap()
    np.testing.assert_array_equal(one.waypoints, other.waypoints)


def test_a_margin_is_kept(field: GaussianCollisionField) -> None:
    plain, careful = (GaussianRRTStar(field, panda(), margin=m) for m in (0.0, 0.02))
    path = careful.plan(LEFT, RIGHT, budget_ms=60_000, iterations=2000).unwrap()
    clearance = plain.arm.clearance(field, path.at(np.linspace(0, 1, 2001)), cut=0.1).distance.min()
    assert clearance >= 0.02
    assert path.certificate.margin == 0.02


def test_a_search_can_be_watched_and_cancelled_from_another_thread(planner: GaussianRRTStar) -> None:
    results = []
    thread = threading.Thread(target=lambda: results.append(planner.plan(LEFT, RIGHT, budget_ms=60_000)))
    thread.start()
    until(lambda: len(planner.best()[0]))
    waypoints, cost, history = planner.best()
    planner.cancel()
    thread.join(20)
    assert not thread.is_alive()
    assert cost == pytest.approx(_length(waypoints))
    assert history[-1, 1] == cost
    assert results[0].status is PlanStatus.SUCCESS
    assert results[0].unwrap().cost <= cost
    assert results[0].seconds < 50


def test_several_threads_may_ask_one_planner(planner: GaussianRRTStar) -> None:
    alone = [planner.plan(LEFT, RIGHT, budget_ms=60_000, iterations=200, seed=k).unwrap().waypoints for k in range(6)]
    found: dict[int, Array] = {}

    def ask(k: int) -> None:
        found[k] = planner.plan(LEFT, RIGHT, budget_ms=60_000, iterations=200, seed=k).unwrap().waypoints

    threads = [threading.Thread(target=ask, args=(k,)) for k in range(6)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(30)
    for k in range(6):
        np.testing.assert_array_equal(found[k], alone[k])


@pytest.mark.parametrize("start", [-0.8, -0.2202])
def test_a_cancelled_search_without_a_path_says_so(ball: GaussianCollisionField, start: float) -> None:
    """A start close to the ball makes the planner choose a smaller eps once the goal is known."""
    planner = GaussianRRTStar(ball, Slider(2))
    planner.cancel()
    result = planner.plan([start, 0.0], [0.8, 0.0])
    assert result.status is PlanStatus.PREEMPTED
    assert not result
    assert planner.plan([start, 0.0], [0.8, 0.0]).status is PlanStatus.SUCCESS


def test_failures_name_what_is_in_the_way(planner: GaussianRRTStar, field: GaussianCollisionField) -> None:
    q = panda().random(2000, np.random.default_rng(0))
    verdict = planner.arm.check(field, q)
    in_map = q[verdict.in_collision & (verdict.other < 0)][0]
    for result, status in (
        (planner.plan(in_map, RIGHT), PlanStatus.START_STATE_IN_COLLISION),
        (planner.plan(LEFT, in_map), PlanStatus.GOAL_IN_COLLISION),
    ):
        assert result.status is status
        assert result.path is None
        assert result.seconds < 1
        cause = cause_of(result)
        nearest = planner.arm.clearance(field, in_map[None])
        assert cause.link == nearest.link[0]
        assert cause.gaussian == nearest.index[0]
        assert cause.depth == pytest.approx(-nearest.distance[0])
        assert f"link {cause.link}" in result.reason
        with pytest.raises(PlanningError, match="Fix:") as raised:
            result.unwrap()
        assert raised.value.code == status.value
    in_itself = q[verdict.in_collision & (verdict.other >= 0)][0]
    result = planner.plan(in_itself, RIGHT)
    assert result.status is PlanStatus.START_STATE_IN_COLLISION
    assert cause_of(result).other >= 0
    assert cause_of(result).gaussian == -1
    assert cause_of(result).depth > 0


def test_joints_beyond_their_limits_are_named(planner: GaussianRRTStar) -> None:
    far = LEFT.copy()
    far[3] = planner.robot.chain.upper[3] + 0.25
    start, goal = planner.plan(far, RIGHT), planner.plan(LEFT, far)
    assert (start.status, goal.status) == (PlanStatus.START_STATE_INVALID, PlanStatus.GOAL_STATE_INVALID)
    for result in (start, goal):
        assert cause_of(result).joint == 3
        assert cause_of(result).depth == pytest.approx(0.25)


def test_a_joint_that_its_encoder_reads_a_hair_beyond_the_limit_is_no_failure(planner: GaussianRRTStar) -> None:
    start = LEFT.copy()
    start[6] = planner.robot.chain.lower[6] - 1e-9
    path = planner.plan(start, RIGHT, budget_ms=60_000, iterations=2000).unwrap()
    np.testing.assert_array_equal(path.waypoints[0], start)


def test_a_goal_that_cannot_be_reached_times_out_and_names_what_blocks_the_straight_way() -> None:
    turns = np.linspace(0, 2 * np.pi, 64, endpoint=False)
    ring = ball_world()
    ring = type(ring).from_activated(
        means=0.4 * np.stack([np.cos(turns), np.sin(turns), np.zeros(64)], axis=1),
        quats=np.tile([1.0, 0, 0, 0], (64, 1)),
        scales=np.full((64, 3), 0.03),
        opacities=np.full(64, 0.9),
        colors=np.full((64, 3), 0.5),
    )
    planner = GaussianRRTStar(GaussianCollisionField(ring), Slider(2))
    result = planner.plan([0.0, 0.0], [0.8, 0.0], budget_ms=50)
    assert result.status is PlanStatus.TIMED_OUT
    assert cause_of(result).gaussian == 0
    assert cause_of(result).link == 2
    exhausted = planner.plan([0.0, 0.0], [0.8, 0.0], budget_ms=60_000, iterations=100)
    assert exhausted.status is PlanStatus.PLANNING_FAILED
    assert exhausted.iterations == 100


def test_of_several_goals_those_out_of_the_way_are_left_out(planner: GaussianRRTStar) -> None:
    beyond = RIGHT + 9.0
    result = planner.plan(LEFT, np.stack([beyond, RIGHT]), budget_ms=60_000, iterations=2000)
    np.testing.assert_array_equal(result.unwrap().waypoints[-1], RIGHT)


@pytest.mark.parametrize("wrong", [np.full(7, np.nan), np.zeros(6), np.zeros((7, 1)), "here"])
def test_starts_and_goals_that_make_no_sense_are_refused(planner: GaussianRRTStar, wrong: object) -> None:
    with pytest.raises(StartError) as start:
        planner.plan(wrong, RIGHT)  # type: ignore[arg-type]
    with pytest.raises(GoalError) as goal:
        planner.plan(LEFT, wrong)  # type: ignore[arg-type]
    assert (start.value.code, goal.value.code) == (-17, -16)


def test_budgets_and_eps_that_make_no_sense_are_refused(
    planner: GaussianRRTStar, field: GaussianCollisionField
) -> None:
    for budget in (0.0, -1.0, np.nan, np.inf):
        with pytest.raises(InputError, match="budget_ms"):
            planner.plan(LEFT, RIGHT, budget_ms=budget)
    with pytest.raises(InputError, match="iterations"):
        planner.plan(LEFT, RIGHT, iterations=0)
    with pytest.raises(InputError, match="eps"):
        GaussianRRTStar(field, panda(), eps=0.0)

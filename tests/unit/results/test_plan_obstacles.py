"""Support plane and unknown space as obstacles of plans."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatbot.bench.tabletop import tabletop
from splatbot.collision import GaussianCollisionField, RobotSpheres, UnknownSpace
from splatbot.errors import SplatbotError
from splatbot.gaussians import GaussianModel, Snapshot
from splatbot.geometry import se3_exp, transform_points
from splatbot.planning import GaussianRRTStar, PoseGoal
from splatbot.results.plan_obstacles import CONSTANTS, PlanObstacles, support_tiles
from splatbot.robots.store import load_robot

T_WORLD_BASE = se3_exp([0.4, -0.2, 0.7, 1.9, 0.2, -0.3])
ARMS = ("panda", "ur5e-2f85", "so100", "iiwa14")
MARGIN = 0.006


def plane_at(height: float) -> np.ndarray:
    """Return a plane (4,) in the world that is ``height`` [m] above the base, as seen from the base."""
    n = T_WORLD_BASE[:3, 2]
    return np.array([*n, -float(n @ T_WORLD_BASE[:3, 3]) - height])


def block(shape: tuple[int, int, int], origin: np.ndarray) -> UnknownSpace:
    """Return an unknown block of 2 cm voxels with known voxels around it."""
    inner = np.zeros(shape, np.bool_)
    inner[1:-1, 1:-1, 1:-1] = True
    return UnknownSpace(inner, inner, origin, 0.02)


@pytest.mark.parametrize("name", ARMS)
def test_nothing_passes_the_plane_and_nothing_above_it_is_blocked(name: str, rng: np.random.Generator) -> None:
    robot = load_robot(name)
    arm = RobotSpheres(robot, T_world_base=T_WORLD_BASE)
    field = GaussianCollisionField(support_tiles(plane_at(0.0), arm, robot.home), 2.0)
    assert not arm.check(field, robot.home[None]).in_collision[0]
    reach = robot.chain.reach(robot.T_link_tcp)
    x, y = rng.uniform(-reach, reach, (2, 4000)) / np.sqrt(2)
    away = np.hypot(x, y) > 0.35  # around the mounted link the arm itself is in the way
    below = np.c_[x, y, np.full(len(x), -0.001)][away]
    assert field.clearance(transform_points(T_WORLD_BASE, below), cut=0.1).distance.max() < 0.0
    above = np.c_[x, y, np.full(len(x), 0.0005)][away]
    assert field.clearance(transform_points(T_WORLD_BASE, above), cut=0.1).distance.min() > 0.0


@pytest.mark.parametrize("name", ARMS)
def test_a_goal_below_the_support_is_refused_with_its_name_and_place_although_the_map_is_empty_there(name: str) -> None:
    robot = load_robot(name)
    arm = RobotSpheres(robot, T_world_base=T_WORLD_BASE)
    model = GaussianModel.from_activated(
        means=T_WORLD_BASE[None, :3, 3] + 5.0, quats=[[1, 0, 0, 0]], scales=np.full((1, 3), 0.01),
        opacities=[0.9], colors=[[0, 0, 0]],
    )  # fmt: skip
    around = PlanObstacles(GaussianCollisionField(model), model, arm, robot.home, plane=plane_at(0.0))
    reach = 0.6 * robot.chain.reach(robot.T_link_tcp)
    T = np.diag([1.0, -1.0, -1.0, 1.0])
    T[:3, 3] = [reach, 0.1, -0.08]
    for goal in (PoseGoal(T_WORLD_BASE @ T),):
        planner = GaussianRRTStar(around.field(MARGIN), robot, T_world_base=T_WORLD_BASE, margin=MARGIN)
        result = planner.plan(robot.home, goal, budget_ms=50)
        assert result.path is None
        free = GaussianRRTStar(GaussianCollisionField(model), robot, T_world_base=T_WORLD_BASE, margin=MARGIN)
        if free.plan(robot.home, goal, budget_ms=200).path is not None:  # reached, but for the plane
            with pytest.raises(SplatbotError, match=r"in the support plane of the scene.yaml at \(.*m from the base"):
                around.check(result)


@pytest.mark.parametrize("name", ARMS)
def test_home_is_free_with_the_margin_of_the_plan(name: str) -> None:
    robot = load_robot(name)
    for margin in (0.0, 0.02, 0.05):
        kept = RobotSpheres(robot, T_world_base=T_WORLD_BASE, margin=margin)
        tiles = support_tiles(plane_at(0.0), kept, robot.home, margin=margin)
        assert not kept.check(GaussianCollisionField(tiles, 2.0), robot.home[None]).in_collision[0]


def test_an_arm_that_is_mounted_below_the_support_or_far_above_it_has_no_tiles() -> None:
    robot = load_robot("panda")
    arm = RobotSpheres(robot, T_world_base=T_WORLD_BASE)
    assert len(support_tiles(plane_at(0.05), arm, robot.home)) == 0  # on a pedestal next to a higher table
    assert len(support_tiles(plane_at(-3.0), arm, robot.home)) == 0
    assert len(support_tiles(plane_at(-0.4), arm, robot.home)) > 1000


def test_kinds_of_obstacles_are_told_apart_in_a_map_with_harmonics() -> None:
    robot = load_robot("panda")
    arm = RobotSpheres(robot)
    model = tabletop().gaussians(2000)
    rich = replace(model, sh=model.sh.repeat(1, 4, 1))
    space = block((40, 40, 40), np.array([0.3, -0.4, 0.1]))
    up = np.array([0.0, 0.0, 1.0, 0.0])
    around = PlanObstacles(
        GaussianCollisionField(rich),
        rich,
        arm,
        robot.home,
        plane=up,
        measured=np.array([[1.0, 2.0, 3.0, 0.01], [2.0, 2.0, 3.0, 0.01]]),
        space=space,
        policy="occupied",
    )
    assert not around.covers_support
    field = around.field(MARGIN)
    assert around.covers_support
    assert len(field) > len(rich) + 1000
    tiles = len(support_tiles(up, arm, robot.home, margin=MARGIN))
    assert {around.kind(k) for k in (0, len(rich) - 1)} == {"the map"}
    assert {around.kind(len(rich) + k) for k in (0, tiles - 1)} == {"the support plane"}
    assert {around.kind(len(rich) + tiles + k) for k in (0, 1)} == {"measured surface"}
    assert {around.kind(len(rich) + tiles + k) for k in (2, 3)} == {"unknown space"}
    drawn = around.solids.means.numpy()
    assert len(drawn) > tiles
    assert np.linalg.norm(drawn - [1.0, 2.0, 3.0], axis=1).min() > 0.1  # the map shows the surface that was measured
    plain = PlanObstacles(GaussianCollisionField(rich), rich, arm, robot.home)
    assert len(plain.field(MARGIN)) == len(rich)
    assert CONSTANTS.radius > CONSTANTS.spacing / np.sqrt(2)


def test_the_field_of_a_plan_keeps_the_version_and_the_gates_of_the_map() -> None:
    robot = load_robot("panda")
    arm = RobotSpheres(robot)
    model = tabletop().gaussians(2000)
    model.observations[:500] = 1
    model.observations[500:] = 5
    field = GaussianCollisionField(Snapshot(model, map_version=7), 2.0, min_opacity=0.2, min_observations=3)
    around = PlanObstacles(field, model, arm, robot.home, plane=np.array([0.0, 0.0, 1.0, 0.3]))
    found = around.field(MARGIN)
    tiles = support_tiles([0.0, 0.0, 1.0, 0.3], arm, robot.home, margin=MARGIN)
    assert found.map_version == 7
    assert len(found) == len(field) + len(tiles)  # gated Gaussians stay out, tiles stay in
    assert (found.gate, found.n_sigma) == (field.gate, field.n_sigma)
    assert around.unknown_field(MARGIN) is None


@pytest.mark.parametrize(
    ("policy", "words"),
    [("occupied", "no frame saw to be empty"), ("cautious", "two frames looked and measured no depth")],
)
def test_a_goal_in_unknown_space_is_named(policy: str, words: str) -> None:
    robot = load_robot("panda")
    arm = RobotSpheres(robot)
    model = tabletop().gaussians(2000)
    space = block((40, 40, 40), np.array([0.0, 0.15, 0.2]))
    around = PlanObstacles(
        GaussianCollisionField(model),
        model,
        arm,
        robot.home,
        space=space,
        policy=policy,  # type: ignore[arg-type]
    )
    goal = robot.home.copy()
    goal[0] += 0.9
    result = GaussianRRTStar(around.field(MARGIN), robot, margin=MARGIN).plan(robot.home, goal, budget_ms=50)
    with pytest.raises(SplatbotError, match=words):
        around.check(result)


@pytest.mark.parametrize("n_sigma", [1.0, 2.0, 3.0])
def test_obstacles_outside_of_the_map_have_their_size_at_any_sigma(n_sigma: float) -> None:
    model = tabletop().gaussians(2000)
    home, arm = load_robot("panda").home, RobotSpheres(load_robot("panda"))
    space = block((12, 12, 12), np.array([0.4, 1.0, 2.0]))
    ball = np.array([[2.0, 3.0, 4.0, 0.004]])
    around = PlanObstacles(
        GaussianCollisionField(model, n_sigma), model, arm, home, measured=ball, space=space, policy="occupied"
    )
    field = around.field(0.0)
    beside_ball, below_block = np.array([2.0, 3.0, 4.03]), space.origin + 0.02 * np.array([6.5, 6.5, -1.5])
    gap = field.clearance(np.stack([beside_ball, below_block]), cut=1.0).distance
    corner = np.sqrt(3) / 2 * space.voxel  # radius of the sphere around the voxel 6, 6, 1
    np.testing.assert_allclose(gap, [0.026, 3 * space.voxel - corner], atol=1e-4)
    alone = around.unknown_field(0.0)
    assert alone is not None
    np.testing.assert_allclose(alone.clearance(below_block[None], cut=1.0).distance, gap[1:], atol=1e-5)

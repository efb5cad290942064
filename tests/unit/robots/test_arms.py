"""Arms that splatbot ships, against the descriptions of their makers, MuJoCo, and the data sheet."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.grasping.sampler import GraspSampler
from splatbot.robots.arms import ARMS, description_of
from splatbot.robots.arms.fit import described
from splatbot.robots.containment import uncovered
from splatbot.robots.robot import RobotModel
from splatbot.robots.store import load_robot
from tests.unit.grasping.objects import BOX, scene, target_of
from tests.unit.robots.makers import assert_held_at_home, assert_moves_as_mujoco, certified_plans

# Denavit and Hartenberg's parameters of the UR5e: a, d [m] and alpha [rad], as Universal Robots publish them.
_UR5E = (
    (0.0, 0.1625, np.pi / 2),
    (-0.425, 0.0, 0.0),
    (-0.3922, 0.0, 0.0),
    (0.0, 0.1333, np.pi / 2),
    (0.0, 0.0997, -np.pi / 2),
    (0.0, 0.0996, 0.0),
)


@pytest.fixture(params=sorted(ARMS))
def name(request: pytest.FixtureRequest) -> str:
    """Name of each shipped arm."""
    return str(request.param)


def _installed(name: str) -> RobotModel:
    pytest.importorskip("collada")
    try:
        return described(name)
    except InputError as error:
        pytest.skip(str(error))


def test_an_arm_moves_as_mujoco_moves_its_makers_description(name: str, rng: np.random.Generator) -> None:
    _installed(name)
    assert_moves_as_mujoco(load_robot(name), description_of(ARMS[name].source), rng)


def test_the_ur5e_moves_as_the_parameters_of_its_maker_say(rng: np.random.Generator) -> None:
    robot = load_robot("ur5e")
    for q in robot.random(50, rng):
        T = np.diag([-1.0, -1.0, 1.0, 1.0])  # ROS's base is turned by half a turn
        for angle, (a, d, alpha) in zip(q, _UR5E, strict=True):
            c, s, ca, sa = np.cos(angle), np.sin(angle), np.cos(alpha), np.sin(alpha)
            T = T @ np.array([[c, -s * ca, s * sa, a * c], [s, c * ca, -c * sa, a * s], [0, sa, ca, d], [0.0, 0, 0, 1]])
        np.testing.assert_allclose(robot.tcp(q), T, atol=1e-6)


def test_stored_joints_are_those_of_the_description(name: str) -> None:
    stored, maker = load_robot(name), _installed(name)
    for field in ("lower", "upper", "velocity", "acceleration", "jerk", "effort"):
        np.testing.assert_array_equal(getattr(stored.chain, field), getattr(maker.chain, field))
    np.testing.assert_array_equal(stored.home, ARMS[name].home)


@pytest.mark.long
def test_every_triangle_of_the_makers_geometry_is_proven_to_lie_in_the_spheres(name: str) -> None:
    assert uncovered(_installed(name).shapes, load_robot(name).spheres()) <= 0


@pytest.mark.long
def test_an_arm_plans_among_obstacles_and_every_path_is_certified(name: str, rng: np.random.Generator) -> None:
    robot = load_robot(name)
    assert len(robot.spheres()) <= 400
    assert certified_plans(robot, rng) >= 9


def test_the_twin_holds_an_arm_at_home(name: str) -> None:
    assert_held_at_home(load_robot(name))


@pytest.mark.long
@pytest.mark.parametrize("name", [f"{name}-{hand}" for name, arm in ARMS.items() for hand in arm.hands])
def test_an_arm_with_a_hand_finds_grasps_that_it_reaches(name: str) -> None:
    robot = load_robot(name)
    result = GraspSampler(scene(), robot).sample(target_of(scene(), BOX, "box"))
    assert result.grasps
    for grasp in result.grasps[:3]:
        assert grasp.q is not None
        np.testing.assert_allclose(robot.tcp(grasp.q), grasp.T_world_tcp, atol=1e-3)
        assert np.abs(BOX.distance(grasp.contacts)).max() < 0.005

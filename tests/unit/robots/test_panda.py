"""The Panda against the toolbox's model of it, and its spheres against its collision shapes."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.protocols import RobotKinematics
from splatbot.robots.containment import uncovered
from splatbot.robots.cover import cover
from splatbot.robots.panda import panda
from splatbot.robots.shapes import Capsule


@pytest.fixture(scope="module")
def toolbox() -> Any:
    """The toolbox's Panda, read from a URDF."""
    rtb = pytest.importorskip("roboticstoolbox")
    return rtb.models.Panda()


def test_the_tool_is_where_the_toolbox_has_it(toolbox: Any, rng: np.random.Generator) -> None:
    q = panda().random(50, rng)
    expected = np.array([toolbox.fkine(row).A for row in q])
    np.testing.assert_allclose(panda().tcp(q), expected, atol=1e-9)


def test_the_jacobian_is_the_toolboxs(toolbox: Any, rng: np.random.Generator) -> None:
    q = panda().random(50, rng)
    np.testing.assert_allclose(panda().jacobian(q), np.array([toolbox.jacob0(row) for row in q]), atol=1e-9)


def test_the_jacobian_of_a_point_on_a_link_equals_finite_differences(rng: np.random.Generator) -> None:
    robot, h = panda(), 1e-6
    q = robot.random(1, rng)[0]
    point = np.array([0.03, -0.02, 0.05, 1.0])

    def at(values: np.ndarray) -> np.ndarray:
        return np.asarray((robot.fk(values)[5] @ point)[:3])

    differences = np.stack([(at(q + h * e) - at(q - h * e)) / (2 * h) for e in np.eye(7)], axis=-1)
    np.testing.assert_allclose(robot.jacobian(q, 5, at(q))[:3], differences, atol=1e-8)


def test_limits_are_those_of_the_toolbox(toolbox: Any) -> None:
    np.testing.assert_allclose([panda().chain.lower, panda().chain.upper], toolbox.qlim, atol=1e-6)


def test_links_have_the_masses_that_the_toolbox_has() -> None:
    rtb = pytest.importorskip("roboticstoolbox")
    masses = [link.m for link in rtb.models.DH.Panda().links]
    np.testing.assert_allclose([i.mass for i in panda().inertials][1:7], masses[:6])
    assert panda().inertials[7].mass == pytest.approx(masses[6] + 0.73 + 2 * 0.015)  # the hand and its fingers
    for inertial in panda().inertials:
        assert np.linalg.eigvalsh(inertial.inertia).min() > 0


def test_every_link_has_spheres_and_few_enough_for_a_plan_with_an_object_in_the_hand() -> None:
    spheres = panda().spheres()
    assert len(spheres) < 256
    assert set(spheres.link.tolist()) == set(range(8))


def test_no_sphere_reaches_farther_than_the_slack_beyond_its_capsule() -> None:
    capsule = Capsule(3, (0.0, 0.1, -0.2), (0.05, 0.1, 0.1), 0.04)
    spheres = cover([capsule], 0.006)
    start, end = np.array(capsule.start), np.array(capsule.end)
    t = np.clip((spheres.centers - start) @ (end - start) / capsule.length**2, 0, 1)
    beyond = np.linalg.norm(spheres.centers - start - t[:, None] * (end - start), axis=1) + spheres.radii - 0.04
    assert beyond.max() <= 0.006 + 1e-12
    assert uncovered([capsule], spheres, 0.001) <= 0


def test_fingers_move_apart_with_the_opening() -> None:
    closed, wide = panda().spheres(0.0), panda().spheres(0.08)
    moved = np.linalg.norm(wide.centers - closed.centers, axis=1)
    np.testing.assert_allclose(moved[moved > 0], 0.04)
    with pytest.raises(InputError, match=r"opening: is 0\.1"):
        panda().spheres(0.1)


def test_neighbours_are_no_pair_and_far_links_are() -> None:
    pairs = {tuple(pair) for pair in panda().self_collision_pairs.tolist()}
    assert not any(b == a + 1 for a, b in pairs)
    assert {(0, 7), (1, 7), (2, 7), (0, 6)} <= pairs


def test_it_is_what_the_core_asks_for() -> None:
    assert isinstance(panda(), RobotKinematics)


@pytest.mark.parametrize(("q", "message"), [([0.0] * 6, "q: is"), ([np.nan] * 7, "not finite")])
def test_configurations_that_make_no_sense_are_named(q: list[float], message: str) -> None:
    with pytest.raises(InputError, match=message):
        panda().fk(q)

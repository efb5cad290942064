"""The nearest moment of a trajectory, against every sphere at every moment."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from splatbot.bench.tabletop import tabletop
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.gaussians import GaussianModel
from splatbot.geometry import se3_exp, transform_points
from splatbot.planning import GaussianRRTStar, JointTrajectory, time_path
from splatbot.planning.closest import CONSTANTS, closest_approach
from splatbot.robots.panda import panda

T_WORLD_BASE = se3_exp([0.0, 0.0, 0.002, 0.0, 0.0, 0.3])
GOAL = np.array([0.9, -0.3, 0.1, -2.0, 0.2, 1.8, 0.5])
MARGIN = 0.004


@pytest.fixture(scope="module")
def planned() -> tuple[RobotSpheres, GaussianCollisionField, JointTrajectory]:
    field = GaussianCollisionField(tabletop().gaussians(4000), 2.0)
    planner = GaussianRRTStar(field, panda(), T_world_base=T_WORLD_BASE, margin=MARGIN)
    path = planner.plan(panda().home, GOAL, budget_ms=60_000, iterations=200).unwrap()
    return planner.arm, field, time_path(path, planner.arm, field)


def test_the_nearest_moment_is_that_of_the_smallest_gap_of_any_sphere(
    planned: tuple[RobotSpheres, GaussianCollisionField, JointTrajectory],
) -> None:
    arm, field, trajectory = planned
    nearest = closest_approach(arm, field, trajectory)
    assert nearest is not None
    moments = np.linspace(0.0, trajectory.duration, CONSTANTS.moments)
    spheres = panda().spheres()
    moving = spheres.link > 0
    gaps = []
    for q in trajectory.at(moments).position:
        T = (T_WORLD_BASE @ panda().fk(q[None])[0])[spheres.link]
        centers = np.einsum("sij,sj->si", T[:, :3, :3], spheres.centers) + T[:, :3, 3]
        gaps.append((field.clearance(centers, cut=0.5).distance - spheres.radii)[moving] - MARGIN)
    least = np.min(gaps, axis=1)
    assert nearest.clearance == pytest.approx(least.min(), abs=1e-5)
    assert nearest.time == pytest.approx(moments[np.argmin(least)])
    assert nearest.link == spheres.link[moving][np.argmin(gaps[int(np.argmin(least))])]
    assert trajectory.certificate.clearance <= nearest.clearance + 1e-6


def test_the_nearest_point_is_as_far_from_the_arm_as_the_gap_says(
    planned: tuple[RobotSpheres, GaussianCollisionField, JointTrajectory],
) -> None:
    arm, field, trajectory = planned
    nearest = closest_approach(arm, field, trajectory)
    assert nearest is not None
    q = trajectory.at(np.array([nearest.time])).position
    away = np.linalg.norm(arm.centers(q)[0] - nearest.point, axis=1) - arm.spheres.radii
    own = arm.spheres.link == nearest.link
    assert away[own].min() - MARGIN == pytest.approx(nearest.clearance, abs=1e-5)
    np.testing.assert_allclose(transform_points(T_WORLD_BASE, nearest.at_base), nearest.point, atol=1e-9)
    assert nearest.name == trajectory.names[nearest.link - 1]
    assert "from the map at" in str(nearest)
    other = closest_approach(arm, field, trajectory, lambda row: f"obstacle {row}")
    assert other is not None
    assert "from obstacle " in str(other)
    assert not replace(nearest, clearance=0.0021).close
    assert replace(nearest, clearance=0.0019).close


def test_without_obstacles_within_half_a_metre_there_is_no_nearest_moment(
    planned: tuple[RobotSpheres, GaussianCollisionField, JointTrajectory],
) -> None:
    arm, _, trajectory = planned
    assert closest_approach(arm, GaussianCollisionField(GaussianModel.empty(0), 2.0), trajectory) is None

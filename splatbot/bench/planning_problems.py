"""Seeded planning problems on the table top: goals are just above the table, and the straight line collides."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.bench.truth import Truth
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel


@dataclass(frozen=True)
class ProblemConstants:
    """Constants of planning problems."""

    max_goal_height: float = 0.22
    """Largest height [m] of the tool above the table. A larger one poses easier problems, above the objects."""
    min_clearance: float = 5e-3
    """True clearance [m] at both ends, so that both are free on every kind of map. A smaller one poses ends that a
    coarse map blocks."""
    batches: int = 20
    """Number of batches [1] of 20,000 configurations that are sampled on a map. More of them find more ends in
    cluttered maps."""


CONSTANTS = ProblemConstants()


@dataclass(frozen=True, eq=False)
class Problem:
    """Start and goal configurations, each (J,)."""

    start: Array
    goal: Array


def problems(
    robot: RobotModel,
    arm: RobotSpheres,
    field: GaussianCollisionField,
    truth: Truth,
    count: int,
    seed: int = 0,
    clearance: float = CONSTANTS.min_clearance,
) -> list[Problem]:
    """Sample ``count`` pairs of configurations with at least ``clearance`` [m] whose straight joint path collides."""
    rng = np.random.default_rng(seed)
    found: list[Problem] = []
    while len(found) < count:
        q = robot.random(20_000, rng)
        q = q[~arm.check(field, q).in_collision]
        q = q[truth.clearances(arm, q) > clearance]
        tool = robot.tcp(q)[:, :3, 3]
        above = tool[:, 2] > 0.0
        low = (
            above
            & (tool[:, 2] < CONSTANTS.max_goal_height)
            & (tool[:, 0] > 0.2)
            & (tool[:, 0] < 0.9)
            & (np.abs(tool[:, 1]) < 0.8)
        )
        starts, goals = q[above & ~low], q[low]
        n = min(len(starts), len(goals))
        blocked = arm.certify(field, starts[:n], goals[:n]).in_collision
        found += [Problem(a, b) for a, b in zip(starts[:n][blocked], goals[:n][blocked], strict=True)]
    return found[:count]


def map_problems(
    robot: RobotModel, arm: RobotSpheres, field: GaussianCollisionField, box: Array, count: int, seed: int = 0
) -> list[Problem]:
    """Sample problems as :func:`problems` on any map, free with the margin of the arm; fewer if there are not enough.

    Args:
        robot: The robot.
        arm: Its spheres; its base is on the work surface, z up.
        field: The map.
        box: (2, 3) corners [m] of the workspace in the frame of the base, which contains the goals.
        count: Largest number of problems.
        seed: Seed of the configurations.
    """
    rng = np.random.default_rng(seed)
    found: list[Problem] = []
    for _ in range(CONSTANTS.batches):
        q = robot.random(20_000, rng)
        q = q[~arm.check(field, q).in_collision]
        tool = robot.tcp(q)[:, :3, 3]
        above = tool[:, 2] > box[0, 2]
        low = (
            above
            & (tool[:, 2] < box[0, 2] + CONSTANTS.max_goal_height)
            & ((tool > box[0]) & (tool < box[1])).all(axis=1)
        )
        starts, goals = q[above & ~low], q[low]
        n = min(len(starts), len(goals))
        blocked = arm.certify(field, starts[:n], goals[:n]).in_collision
        found += [Problem(a, b) for a, b in zip(starts[:n][blocked], goals[:n][blocked], strict=True)]
        if len(found) >= count:
            break
    return found[:count]

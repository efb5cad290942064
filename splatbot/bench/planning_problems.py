"""Seeded planning problems on the table top: from anywhere to close above the table, with something in between."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from splatbot.bench.truth import Truth
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.protocols import Array
from splatbot.robots.robot import RobotModel

HAND = 0.22  # [m] that the tool is at most above the table at the goal
ROOM = 5e-3  # [m] of true room at both ends, so that a problem is one on every kind of map


@dataclass(frozen=True, eq=False)
class Problem:
    """From one configuration (J,) to another."""

    start: Array
    goal: Array


def problems(
    robot: RobotModel, arm: RobotSpheres, field: GaussianCollisionField, truth: Truth, count: int, seed: int = 0
) -> list[Problem]:
    """``count`` pairs of free configurations between which the straight line in joint space collides."""
    rng = np.random.default_rng(seed)
    found: list[Problem] = []
    while len(found) < count:
        q = robot.random(20_000, rng)
        q = q[~arm.check(field, q).in_collision]
        q = q[truth.rooms(arm, q) > ROOM]
        tool = robot.tcp(q)[:, :3, 3]
        above = tool[:, 2] > 0.0
        low = above & (tool[:, 2] < HAND) & (tool[:, 0] > 0.2) & (tool[:, 0] < 0.9) & (np.abs(tool[:, 1]) < 0.8)
        starts, goals = q[above & ~low], q[low]
        n = min(len(starts), len(goals))
        blocked = arm.certify(field, starts[:n], goals[:n]).in_collision
        found += [Problem(a, b) for a, b in zip(starts[:n][blocked], goals[:n][blocked], strict=True)]
    return found[:count]

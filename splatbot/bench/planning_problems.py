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
_BATCHES = 20  # of 20,000 configurations that are looked at on a map


@dataclass(frozen=True, eq=False)
class Problem:
    """From one configuration (J,) to another."""

    start: Array
    goal: Array


def problems(
    robot: RobotModel,
    arm: RobotSpheres,
    field: GaussianCollisionField,
    truth: Truth,
    count: int,
    seed: int = 0,
    room: float = ROOM,
) -> list[Problem]:
    """``count`` pairs of configurations with ``room`` [m] between which the straight line in joint space collides."""
    rng = np.random.default_rng(seed)
    found: list[Problem] = []
    while len(found) < count:
        q = robot.random(20_000, rng)
        q = q[~arm.check(field, q).in_collision]
        q = q[truth.rooms(arm, q) > room]
        tool = robot.tcp(q)[:, :3, 3]
        above = tool[:, 2] > 0.0
        low = above & (tool[:, 2] < HAND) & (tool[:, 0] > 0.2) & (tool[:, 0] < 0.9) & (np.abs(tool[:, 1]) < 0.8)
        starts, goals = q[above & ~low], q[low]
        n = min(len(starts), len(goals))
        blocked = arm.certify(field, starts[:n], goals[:n]).in_collision
        found += [Problem(a, b) for a, b in zip(starts[:n][blocked], goals[:n][blocked], strict=True)]
    return found[:count]


def map_problems(
    robot: RobotModel, arm: RobotSpheres, field: GaussianCollisionField, box: Array, count: int, seed: int = 0
) -> list[Problem]:
    """As :func:`problems` on any map, free with the arm's margin; fewer where there are no more of them.

    Args:
        robot: of whom the goals are.
        arm: its spheres, whose base stands on the surface that is worked on, z up.
        field: the map.
        box: (2, 3) corners of the space to work in [m], in the base's frame: where the goals are.
        count: how many.
        seed: of the configurations.
    """
    rng = np.random.default_rng(seed)
    found: list[Problem] = []
    for _ in range(_BATCHES):
        q = robot.random(20_000, rng)
        q = q[~arm.check(field, q).in_collision]
        tool = robot.tcp(q)[:, :3, 3]
        above = tool[:, 2] > box[0, 2]
        low = above & (tool[:, 2] < box[0, 2] + HAND) & ((tool > box[0]) & (tool < box[1])).all(axis=1)
        starts, goals = q[above & ~low], q[low]
        n = min(len(starts), len(goals))
        blocked = arm.certify(field, starts[:n], goals[:n]).in_collision
        found += [Problem(a, b) for a, b in zip(starts[:n][blocked], goals[:n][blocked], strict=True)]
        if len(found) >= count:
            break
    return found[:count]

"""Tests of splatbot.results.unknown."""

from __future__ import annotations

import numpy as np

from splatbot.collision import GaussianCollisionField, RobotSpheres, UnknownSpace
from splatbot.results.unknown import obstacles
from splatbot.robots.panda import panda

MARGIN = 0.02


def around_the_arm() -> UnknownSpace:
    """Return unknown space around a Panda at its home posture: every second voxel of 2 cm, so that all are rims."""
    every_second = np.indices((50, 50, 50)).sum(axis=0) % 2 == 0
    return UnknownSpace(every_second, every_second, np.array([-0.3, -0.5, 0.05]), 0.02)


def test_a_start_in_unknown_space_is_free_with_the_margin_of_the_plan() -> None:
    home, arm = panda().home, RobotSpheres(panda())
    kept = RobotSpheres(panda(), margin=MARGIN)
    bare = GaussianCollisionField(obstacles(around_the_arm(), "occupied", arm, home))
    assert not arm.check(bare, home[None]).in_collision[0]
    assert kept.check(bare, home[None]).in_collision[0]
    cleared = GaussianCollisionField(obstacles(around_the_arm(), "occupied", arm, home, margin=MARGIN))
    assert not kept.check(cleared, home[None]).in_collision[0]
    assert kept.check(cleared, home[None] + 0.4).in_collision[0]

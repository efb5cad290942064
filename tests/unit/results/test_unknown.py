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


def test_an_arm_that_starts_in_unknown_space_does_not_move_farther_into_it() -> None:
    everything = np.ones((100, 100, 100), np.bool_)
    space = UnknownSpace(everything, ~everything, np.array([-1.0, -1.0, 0.02]), 0.02)
    home, arm = panda().home, RobotSpheres(panda(), margin=MARGIN)
    field = GaussianCollisionField(obstacles(space, "occupied", arm, home, margin=MARGIN))
    assert not arm.check(field, home[None]).in_collision[0]
    for joint in range(6):  # the last joint turns the hand alone
        moved = home.copy()
        moved[joint] += 0.3
        edge = arm.certify(field, home[None], moved[None])
        assert edge.in_collision[0], joint
    nothing = obstacles(space, "cautious", arm, home, margin=MARGIN)
    assert len(nothing) == 0


def test_the_voxels_that_spheres_meet_are_left_out_as_an_exhaustive_search_finds_them() -> None:
    rng = np.random.default_rng(0)
    unknown = rng.random((20, 24, 28)) < 0.5
    space = UnknownSpace(unknown, unknown & (rng.random(unknown.shape) < 0.5), np.array([0.3, -0.2, 1.0]), 0.013)
    low, high = space.origin - 0.1, space.origin + 0.013 * np.array(unknown.shape) + 0.1
    spheres = np.c_[rng.uniform(low, high, (60, 3)), rng.uniform(0.0, 0.05, 60)]
    left = space.without(spheres)
    centers = space.origin + (np.argwhere(np.ones_like(unknown)) + 0.5) * space.voxel
    gap = np.linalg.norm(centers[:, None] - spheres[None, :, :3], axis=2) - spheres[:, 3]
    met = (gap < np.sqrt(3) / 2 * space.voxel).any(axis=1).reshape(unknown.shape)
    np.testing.assert_array_equal(left.unknown, unknown & ~met)
    np.testing.assert_array_equal(left.suspect, space.suspect & ~met)
    assert 0.05 < met.mean() < 0.95

"""Camera paths of fly-throughs: rotations stay rotations, shake goes, the way stays."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.geometry import se3_exp
from splatbot.rasterize.fly_through import smooth_path
from splatbot.trajectory import Trajectory


def shaken(seed: int, shake: float, count: int = 200) -> tuple[Trajectory, np.ndarray]:
    """Return a path that turns half a turn while it moves 2 m, with noise of ``shake`` [m, rad], and without noise."""
    rng = np.random.default_rng(seed)
    share = np.linspace(0, 1, count)
    exact = np.stack([se3_exp(np.array([0, 0, 0, 0, np.pi * s, 0])) for s in share])
    exact[:, 0, 3] = 2 * share
    noise = np.stack([se3_exp(x) for x in rng.normal(0, shake, (count, 6))])
    return Trajectory(np.arange(count) / 30, exact @ noise), exact


@pytest.mark.parametrize("seed", range(5))
def test_poses_are_rigid_and_nearer_to_the_path_than_the_shaking_hand(seed: int) -> None:
    trajectory, exact = shaken(seed, 0.03)
    T = smooth_path(trajectory, 200)
    np.testing.assert_allclose(
        T[:, :3, :3] @ T[:, :3, :3].transpose(0, 2, 1), np.tile(np.eye(3), (200, 1, 1)), atol=1e-12
    )
    np.testing.assert_allclose(np.linalg.det(T[:, :3, :3]), 1.0)
    inner = slice(30, -30)
    error = np.linalg.norm(T[inner, :3, 3] - exact[inner, :3, 3], axis=1).mean()
    before = np.linalg.norm(trajectory.positions[inner] - exact[inner, :3, 3], axis=1).mean()
    assert error < before / 2
    jerk = np.abs(np.diff(T[:, :3, 3], 2, axis=0)).mean() / np.abs(np.diff(trajectory.positions, 2, axis=0)).mean()
    assert jerk < 0.05


def test_a_path_has_the_number_of_poses_that_is_requested() -> None:
    trajectory, _ = shaken(0, 0.0, count=7)
    assert smooth_path(trajectory, 50).shape == (50, 4, 4)


def test_opposite_rotations_give_a_rotation() -> None:
    T = np.tile(np.eye(4), (2, 1, 1))
    T[1] = se3_exp(np.array([0, 0, 0, 0, 0, np.pi]))
    R = smooth_path(Trajectory(np.array([0.0, 1.0]), T), 9)[:, :3, :3]
    np.testing.assert_allclose(np.linalg.det(R), 1.0)


def test_one_pose_is_no_path() -> None:
    with pytest.raises(InputError, match="fewer than two poses"):
        smooth_path(Trajectory(np.zeros(1), np.eye(4)[None]), 10)

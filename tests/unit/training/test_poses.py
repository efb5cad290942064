"""Gradients of poses on SE(3)."""

from __future__ import annotations

import numpy as np
import torch

from splatbot.geometry import inverse, look_at, se3_exp
from splatbot.training.poses import CameraPoses, tangent_gradient


def test_the_gradient_equals_finite_differences_of_the_left_increment(rng: np.random.Generator) -> None:
    T = look_at(np.array([1.0, -0.4, 2.0]), np.array([0.1, 0.2, 0.3]))
    weights = rng.normal(size=(4, 4))

    def loss(xi: np.ndarray) -> float:
        return float((weights[:3] * (se3_exp(xi) @ T)[:3]).sum())

    steps = 1e-6 * np.eye(6)
    numeric = np.array([(loss(step) - loss(-step)) / 2e-6 for step in steps])
    np.testing.assert_allclose(tangent_gradient(T, weights), numeric, atol=1e-8)


def test_only_the_pose_of_the_step_moves_and_it_stays_rigid() -> None:
    poses = CameraPoses([np.eye(4)] * 3, extent=2.0)
    for _ in range(50):
        poses.step(1, torch.randn(4, 4, generator=torch.Generator().manual_seed(1)), 1e-2)
    moved = poses.poses()
    np.testing.assert_array_equal(moved[[0, 2]], np.stack([np.eye(4)] * 2))
    assert np.abs(moved[1] - np.eye(4)).max() > 0.1
    np.testing.assert_allclose(moved[1, :3, :3] @ moved[1, :3, :3].T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(inverse(moved[1]), poses.viewmats[1].numpy(), atol=1e-12)

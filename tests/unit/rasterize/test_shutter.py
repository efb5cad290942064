"""How a camera moves between its first and its last line."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch import Tensor

from splatbot.errors import InputError
from splatbot.geometry import se3_exp, so3_log
from splatbot.rasterize.shutter import motion_between


def pose(*xi: float) -> Tensor:
    return torch.from_numpy(se3_exp(list(xi)))


def test_half_way_between_two_poses_lies_the_middle_pose() -> None:
    first, last = pose(0.1, 0.2, 0.3, 0.4, -0.2, 0.1), pose(0.3, 0.2, 0.1, 0.2, 0.5, -0.3)
    motion = motion_between(first, last)
    again = motion_between(motion.middle, last)
    assert np.allclose(2 * again.turn, motion.turn, atol=1e-12)
    assert np.allclose(2 * again.step, motion.step, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-9, 1e-5, 0.0141, 0.0143, 0.5, 1.57])
def test_turns_of_any_size_are_those_of_the_logarithm(angle: float) -> None:
    axis = np.array([0.6, -0.48, 0.64])
    first = pose(0.0, 0.0, 0.0, 0.3, 0.2, -0.4)
    last = pose(0.0, 0.0, 0.0, *(angle * axis)) @ first
    want = so3_log((last[:3, :3] @ first[:3, :3].T).numpy())
    assert np.allclose(motion_between(first, last).turn, want, rtol=1e-9, atol=1e-12)


@pytest.mark.parametrize("angle", [0.0, 1e-3, 0.3, 1.5])
def test_the_motion_is_differentiable_in_both_poses(angle: float) -> None:
    first = pose(0.1, 0.0, 0.2, 0.3, 0.2, -0.4)
    last = pose(0.02, 0.01, 0.0, angle, 0.0, 0.0) @ first

    def moved(a: Tensor, b: Tensor) -> Tensor:
        motion = motion_between(a, b)
        return torch.cat([motion.flat(), motion.middle[:3].reshape(-1)])

    assert torch.autograd.gradcheck(moved, (first.requires_grad_(), last.requires_grad_()), atol=1e-6)


def test_poses_too_far_apart_are_refused() -> None:
    with pytest.raises(InputError, match="100 degrees"):
        motion_between(pose(*[0.0] * 6), pose(0.0, 0.0, 0.0, 0.0, np.radians(100.0), 0.0))

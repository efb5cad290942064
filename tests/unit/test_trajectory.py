"""Trajectory: invalid inputs."""

from __future__ import annotations

import numpy as np
import pytest

from splatbot.errors import InputError
from splatbot.trajectory import Trajectory


def poses(n: int) -> np.ndarray:
    return np.tile(np.eye(4), (n, 1, 1))


def test_select_keeps_stamps_and_poses_together() -> None:
    T = poses(4)
    T[:, 0, 3] = [0, 1, 2, 3]
    part = Trajectory(np.arange(4.0), T).select(np.array([False, True, False, True]))
    assert part.stamps.tolist() == [1, 3]
    assert part.positions[:, 0].tolist() == [1, 3]


def test_shapes_must_fit() -> None:
    with pytest.raises(InputError, match="stamps are"):
        Trajectory(np.arange(3.0), poses(2))


@pytest.mark.parametrize("stamps", [[0.0, 2.0, 1.0], [0.0, 1.0, 1.0]])
def test_stamps_must_increase(stamps: list[float]) -> None:
    with pytest.raises(InputError, match="row 2") as caught:
        Trajectory(np.array(stamps), poses(3))
    assert caught.value.field == "stamps"


def test_values_must_be_finite() -> None:
    T = poses(3)
    T[1, 0, 3] = np.nan
    with pytest.raises(InputError, match="row 1") as caught:
        Trajectory(np.arange(3.0), T)
    assert caught.value.field == "T_world_camera"

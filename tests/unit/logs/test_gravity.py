"""Up direction from an accelerometer whose axes on the camera are not recorded."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from splatbot.errors import LogError
from splatbot.geometry import so3_exp
from splatbot.logs.gravity import NAME, measured_up
from splatbot.trajectory import Trajectory

_UP = np.array([0.2, -0.9, -0.3]) / np.linalg.norm([0.2, -0.9, -0.3])
_AXES = np.array([[0.0, -1, 0], [1, 0, 0], [0, 0, 1]])  # from the accelerometer to the camera


def _log(folder: Path, swing: float, noise: float = 0.05) -> Trajectory:
    """Write the accelerometer of a camera that turns by ``swing`` [rad] about all axes, and return its poses."""
    rng = np.random.default_rng(0)
    stamps = np.arange(60) / 30.0
    poses = np.tile(np.eye(4), (60, 1, 1))
    for k, t in enumerate(stamps):
        poses[k, :3, :3] = so3_exp(swing * np.array([np.sin(3 * t), np.sin(2 * t + 1), np.cos(4 * t)]))
    rows = [
        [t, *(_AXES.T @ T[:3, :3].T @ (9.81 * _UP) + rng.normal(0, noise, 3))]
        for t, T in zip(stamps, poses, strict=True)
    ]
    np.savetxt(folder / NAME, rows, header="timestamp ax ay az [m/s^2]")
    return Trajectory(stamps, poses)


def test_the_direction_is_found_although_the_axes_are_unknown(tmp_path: Path) -> None:
    found = measured_up(str(tmp_path), _log(tmp_path, 0.5))
    assert found is not None
    assert np.degrees(np.arccos(np.clip(np.dot(found, _UP), -1, 1))) < 1.0


def test_a_camera_that_hardly_turns_cannot_tell(tmp_path: Path) -> None:
    assert measured_up(str(tmp_path), _log(tmp_path, 0.003)) is None


def test_without_an_accelerometer_there_is_no_answer_and_a_damaged_file_is_named(tmp_path: Path) -> None:
    trajectory = _log(tmp_path, 0.5)
    (tmp_path / NAME).write_text("1.0 a b c\n")
    with pytest.raises(LogError, match="accelerometer"):
        measured_up(str(tmp_path), trajectory)
    (tmp_path / NAME).unlink()
    assert measured_up(str(tmp_path), trajectory) is None

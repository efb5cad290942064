"""Up direction from the accelerometer of a log.

TUM recordings have `accelerometer.txt` (stamp ax ay az), recordings of ROS topics have messages of sensor_msgs/Imu.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import permutations, product
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.errors import LogError
from splatbot.layouts import log_kind
from splatbot.logs.address import split_address
from splatbot.trajectory import Trajectory

NAME = "accelerometer.txt"


@dataclass(frozen=True)
class GravityConstants:
    """Constants of the measured up direction.

    Args:
        window: [s] time around a pose in which the accelerometer is averaged.
        gravity: [m/s²] range of the mean acceleration of a camera that hardly accelerates.
        min_poses: least number of poses with such a mean.
        max_spread: [deg] largest spread of the directions in the world for the best axes.
        min_ratio: least spread of the second-best axes relative to the best; below it the axes are ambiguous.
    """

    window: float = 0.05
    gravity: tuple[float, float] = (9.0, 10.6)
    min_poses: int = 10
    max_spread: float = 6.0
    min_ratio: float = 2.0


CONSTANTS = GravityConstants()


def measured_up(uri: str, trajectory: Trajectory) -> tuple[float, float, float] | None:
    """Return the upward unit vector in the world of a trajectory, or None if the log does not determine it.

    Recordings of ROS topics may state the axes of the accelerometer on the camera. If they do not, or if the poses
    contradict them, the axes are one of the 24 rotations by right angles. The function chooses that for which gravity
    has the same direction in the world at all poses. If the motion does not distinguish them, the answer is None.

    Args:
        uri: address of the log.
        trajectory: poses T_world_camera of the log's frames.

    Raises:
        LogError: the file is damaged.
    """
    rows, has_axes = _accelerations(uri)
    if rows is None or len(trajectory) < CONSTANTS.min_poses:
        return None
    steady = [(T[:3, :3], mean) for stamp, T in _poses(trajectory) if (mean := _mean_around(rows, stamp)) is not None]
    if len(steady) < CONSTANTS.min_poses:
        return None
    R = np.stack([rotation for rotation, _ in steady])
    a = np.stack([mean / np.linalg.norm(mean) for _, mean in steady])
    spread, stated = _spread(R, a)
    if has_axes and spread <= CONSTANTS.max_spread:
        x, y, z = stated.tolist()
        return (x, y, z)
    found = sorted((_spread(R @ axes, a) for axes in _right_angles()), key=lambda pair: pair[0])
    best, second = found[0], found[1]
    if best[0] > CONSTANTS.max_spread or second[0] < CONSTANTS.min_ratio * best[0]:
        return None
    x, y, z = best[1].tolist()
    return (x, y, z)


def _accelerations(uri: str) -> tuple[NDArray[np.float64] | None, bool]:
    """Return stamps and specific forces (N, 4), None if the log has none, and whether their axes are the camera's."""
    path = Path(uri) / NAME
    if path.is_file():
        return _read_text(path), False
    if not Path(uri.partition("?")[0]).exists() or log_kind(uri) != "bag":
        return None, False
    from splatbot.logs.bag import KEYS, BagLog  # rosbags builds its message classes when imported

    place, options = split_address(uri, KEYS)
    low, high = CONSTANTS.gravity
    log = BagLog(place, options=options)
    if log.imu is not None and len(log.imu.accel_stamps):
        return log.imu.accelerometer, True
    # A camera that hardly accelerates measures gravity.
    topics = log.accelerations().values()
    still = [rows for rows in topics if low < np.median(np.linalg.norm(rows[:, 1:], axis=1)) < high]
    return max(still, key=len, default=None), False


def _read_text(path: Path) -> NDArray[np.float64]:
    try:
        rows = np.loadtxt(path, comments="#", ndmin=2)
    except ValueError as error:
        raise LogError(f"is no list of numbers ({error}).", file=path, hint="write: stamp ax ay az") from error
    if rows.shape[1] < 4:
        raise LogError(f"has {rows.shape[1]} columns.", file=path, hint="write: stamp ax ay az")
    return np.asarray(rows[:, :4])


def _poses(trajectory: Trajectory) -> list[tuple[float, NDArray[np.float64]]]:
    return list(zip(trajectory.stamps.tolist(), trajectory.T_world_camera, strict=True))


def _mean_around(rows: NDArray[np.float64], stamp: float) -> NDArray[np.float64] | None:
    near = np.abs(rows[:, 0] - stamp) < CONSTANTS.window
    if not near.any():
        return None
    mean: NDArray[np.float64] = rows[near, 1:4].mean(axis=0)
    low, high = CONSTANTS.gravity
    return mean if low < np.linalg.norm(mean) < high else None


def _spread(R: NDArray[np.float64], a: NDArray[np.float64]) -> tuple[float, NDArray[np.float64]]:
    """Return the median angle [deg] between the directions in the world and their mean, and the mean (3,)."""
    directions = np.einsum("nij,nj->ni", R, a)
    mean = np.median(directions, axis=0)
    mean = mean / max(float(np.linalg.norm(mean)), 1e-12)
    return float(np.degrees(np.median(np.arccos(np.clip(directions @ mean, -1.0, 1.0))))), mean


def _right_angles() -> list[NDArray[np.float64]]:
    """Return the 24 rotations (3, 3) by right angles."""
    found = []
    for order, signs in product(permutations(range(3)), product((1.0, -1.0), repeat=3)):
        axes = np.zeros((3, 3))
        axes[range(3), order] = signs
        if np.linalg.det(axes) > 0:
            found.append(axes)
    return found

"""Samples of an inertial sensor that a library delivers in its own threads, for the frames of a camera."""

from __future__ import annotations

import logging
from collections import deque
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from splatbot.imu import ImuSamples
from splatbot.protocols import Array

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class ImuBufferConstants:
    """Constants of buffers.

    Args:
        samples: of a sensor that wait for the next frame; older ones are dropped.
    """

    samples: int = 2000


CONSTANTS = ImuBufferConstants()


class ImuBuffer:
    """Collects samples, and returns those up to each frame in the axes of the camera.

    Each sensor has stamps of its own. Samples may be added while others are taken.

    Args:
        R_camera_gyro, R_camera_accel: (3, 3) axes of the sensors in those of the camera.
    """

    def __init__(self, R_camera_gyro: Array, R_camera_accel: Array) -> None:
        self._axes = R_camera_gyro, R_camera_accel
        self._gyro: deque[tuple[float, ...]] = deque(maxlen=CONSTANTS.samples)
        self._accel: deque[tuple[float, ...]] = deque(maxlen=CONSTANTS.samples)
        self._waiting = ImuSamples.of()

    def __len__(self) -> int:
        """Return the number of samples that no frame has taken yet."""
        return len(self._gyro) + len(self._accel)

    def add_rate(self, stamp: float, x: float, y: float, z: float) -> None:
        """Add an angular rate [rad/s] with its time [s]."""
        self._gyro.append((stamp, x, y, z))

    def add_force(self, stamp: float, x: float, y: float, z: float) -> None:
        """Add a specific force [m/s²] with its time [s]."""
        self._accel.append((stamp, x, y, z))

    def until(self, stamp: float, shift: float) -> ImuSamples:
        """Return the samples up to a time [s] that were not returned yet; later ones wait for the next frame.

        Args:
            stamp: time [s] on the clock of the frames.
            shift: time [s] from the clock of the added samples to that of the frames.
        """
        gyro, accel = (_taken(rows, R, shift) for rows, R in zip((self._gyro, self._accel), self._axes, strict=True))
        samples = self._waiting.joined(ImuSamples.of(gyro, accel))
        self._waiting = samples.between(stamp, np.inf)
        return samples.between(-np.inf, stamp)


def _taken(rows: deque[tuple[float, ...]], R: Array, shift: float) -> Array:
    """Return the rows (N, 4) with shifted stamps and turned vectors, and remove them from the queue."""
    table = np.array([rows.popleft() for _ in range(len(rows))], np.float64).reshape(-1, 4)
    return np.column_stack([table[:, 0] + shift, table[:, 1:] @ R.T])


def factory_axes(matrix: ArrayLike) -> Array:
    """Return the rotation (3, 3) of a factory calibration.

    Raises:
        ValueError: it is no rotation.
    """
    R = np.asarray(matrix, np.float64)
    if not np.allclose(R @ R.T, np.eye(3), atol=1e-3) or np.linalg.det(R) < 0:
        raise ValueError("the matrix of its axes is no rotation")
    return R


def warn_of_unused_imu(camera: str, reason: Any) -> None:
    """Report that the inertial sensor of a camera is not used."""
    _log.warning("the IMU of %s is not used: %s", camera, reason)

"""State of the relocalization of a lost camera: search position, and a pose that the next frame has to confirm."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.tracking.hypothesis import ScoredHypothesis
from splatbot.tracking.nearby_keyframes import pose_distance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class RelocalizationConstants:
    """Empirical constants of the confirmation. Stricter values cause fewer wrong poses and more lost frames."""

    min_inliers: float = 0.45
    """Share of inlier residuals [1], photometric and geometric: stricter than for a frame after a tracked one."""
    slack: tuple[float, float] = (0.03, 0.05)
    """Distance [m] and angle [rad] between the two poses in addition to the motion of the camera."""
    max_speed: tuple[float, float] = (2.0, 4.0)
    """Largest speed [m/s] and angular speed [rad/s] of the camera between the two frames."""


CONSTANTS = RelocalizationConstants()


@dataclass(frozen=True, eq=False)
class RelocalizationCandidate:
    """A pose found while lost that the next frame has to confirm.

    Args:
        stamp: time [s] of its frame.
        T_world_camera: (4, 4).
    """

    stamp: float
    T_world_camera: Array

    def agrees(self, stamp: float, T_world_camera: Array) -> bool:
        """Return True if a camera can move from this pose to another (4, 4) in the time between them."""
        limits = np.add(CONSTANTS.slack, np.multiply(CONSTANTS.max_speed, abs(stamp - self.stamp)))
        return bool(np.all(pose_distance(self.T_world_camera, T_world_camera) <= limits))


class PlaceSearch:
    """Position of the search for a lost camera among the keyframes, which continues on the next frame."""

    def __init__(self) -> None:
        self._next = 0

    def restart(self) -> None:
        """Begin the next search with the latest keyframe."""
        self._next = 0

    def next_index(self, n_keyframes: int) -> int:
        """Return the index of the keyframe to compare next, from the latest to the first and again."""
        index = n_keyframes - 1 - self._next % n_keyframes
        self._next += 1
        return index


def is_confident(pose: ScoredHypothesis) -> bool:
    """Return True if enough residuals of a pose are inliers to relocalize at it."""
    health = pose.health
    inliers = min(health.photometric_inliers, health.geometric_inliers)
    return pose.verdict != "lost" and inliers >= CONSTANTS.min_inliers

"""Interface of a keyframe for tracking, and the keyframes nearest to a pose."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from splatbot.geometry import inverse, rotation_angles, so3_log
from splatbot.tracking.features import Features
from splatbot.tracking.reference import Reference

Array = NDArray[np.float64]


class TrackedKeyframe(Protocol):
    """Attributes of a keyframe that tracking uses."""

    @property
    def features(self) -> Features: ...

    @property
    def reference(self) -> Reference: ...


def pose_distance(T_world_a: Array, T_world_b: Array) -> tuple[float, float]:
    """Compute the distance [m] and the angle [rad] between two poses (4, 4)."""
    T_a_b = inverse(T_world_a) @ T_world_b
    return float(np.linalg.norm(T_a_b[:3, 3])), float(np.linalg.norm(so3_log(T_a_b[:3, :3])))


def is_within(distance: tuple[float, float], limits: tuple[float, float], *, times: float = 1.0) -> bool:
    """Return whether a distance [m] and an angle [rad] are both below their limits, or below ``times`` these."""
    return distance[0] < times * limits[0] and distance[1] < times * limits[1]


def order_by_distance(keyframes: Sequence[TrackedKeyframe], T_world_camera: Array) -> list[int]:
    """Order keyframes by their distance to a pose (4, 4), and return their indices; one radian counts as 0.5 m."""
    if not keyframes:
        return []
    poses = np.stack([keyframe.reference.T_world_camera for keyframe in keyframes])
    moved = np.linalg.norm(poses[:, :3, 3] - T_world_camera[:3, 3], axis=1)
    turned = rotation_angles(poses[:, :3, :3].transpose(0, 2, 1) @ T_world_camera[:3, :3])
    return [int(k) for k in np.argsort(moved + 0.5 * turned, kind="stable")]


def nearest(keyframes: Sequence[TrackedKeyframe], T_world_camera: Array, n: int) -> list[TrackedKeyframe]:
    """Return the n keyframes nearest to a pose (4, 4)."""
    return [keyframes[k] for k in order_by_distance(keyframes, T_world_camera)[:n]]

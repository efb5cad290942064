"""Keyframes' poses and the measured motions between them; the poses that fit all of them best."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from numpy.typing import NDArray

from splatbot.geometry import inverse, se3_log

Array = NDArray[np.float64]

_CAUCHY = 1.0  # [σ] from which a loop counts less
# No measured motion is better than this, whatever its residuals say [m], [rad].
_FLOOR = np.diag([1e-3**2] * 3 + [5e-4**2] * 3)


@dataclass(frozen=True)
class Edge:
    """A measured motion between two keyframes.

    Args:
        first, second: their numbers.
        T_first_second: (4, 4).
        covariance: (6, 6) of the twist (t [m], ω [rad]) in the second camera's frame.
        loop: whether it was found by recognising a place, and may be wrong.
    """

    first: int
    second: int
    T_first_second: Array
    covariance: Array
    loop: bool = False

    def residual(self, poses: Mapping[int, Array]) -> Array:
        """Twist (6,) from the measured motion to that of ``poses``, in the second camera's frame."""
        T = inverse(poses[self.first]) @ poses[self.second]
        return se3_log(inverse(self.T_first_second) @ T)


class PoseGraph:
    """Poses T_world_camera by keyframe number, and edges between them."""

    def __init__(self) -> None:
        self.poses: dict[int, Array] = {}
        self.edges: list[Edge] = []

    def near(self, number: int, hops: int) -> set[int]:
        """Keyframes that are at most so many edges away."""
        neighbours: dict[int, list[int]] = {}
        for edge in self.edges:
            neighbours.setdefault(edge.first, []).append(edge.second)
            neighbours.setdefault(edge.second, []).append(edge.first)
        found, front = {number}, deque([(number, 0)])
        while front:
            at, distance = front.popleft()
            for other in neighbours.get(at, ()) if distance < hops else ():
                if other not in found:
                    found.add(other)
                    front.append((other, distance + 1))
        return found

    def path(self, first: int, second: int) -> tuple[float, float]:
        """Metres and radians of the shortest way (in edges) from one keyframe to another, loops left out; inf: none."""
        way = self._way(first, second)
        if way is None:
            return np.inf, np.inf
        steps = [se3_log(inverse(self.poses[a]) @ self.poses[b]) for a, b in pairwise(way)]
        return (
            float(sum(np.linalg.norm(step[:3]) for step in steps)),
            float(sum(np.linalg.norm(step[3:]) for step in steps)),
        )

    def optimised(self) -> dict[int, Array]:
        """Poses of least squares, the first keyframe's held; loops count as Cauchy's function has it.

        Levenberg-Marquardt on SE(3), by gtsam.
        """
        graph, values = gtsam.NonlinearFactorGraph(), gtsam.Values()
        fixed = min(self.poses)
        for number, T in self.poses.items():
            values.insert(number, gtsam.Pose3(T))
        graph.add(gtsam.PriorFactorPose3(fixed, gtsam.Pose3(self.poses[fixed]), _noise(1e-8 * np.eye(6))))
        for edge in self.edges:
            noise = _noise(edge.covariance + _FLOOR)
            if edge.loop:
                robust = gtsam.noiseModel.mEstimator.Cauchy.Create(_CAUCHY)
                noise = gtsam.noiseModel.Robust.Create(robust, noise)
            graph.add(gtsam.BetweenFactorPose3(edge.first, edge.second, gtsam.Pose3(edge.T_first_second), noise))
        found = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        return {number: _orthonormal(found.atPose3(number).matrix()) for number in self.poses}

    def _way(self, first: int, second: int) -> list[int] | None:
        before: dict[int, int] = {first: first}
        front = deque([first])
        links: dict[int, list[int]] = {}
        for edge in self.edges:
            if not edge.loop:
                links.setdefault(edge.first, []).append(edge.second)
                links.setdefault(edge.second, []).append(edge.first)
        while front and second not in before:
            at = front.popleft()
            for other in links.get(at, ()):
                if other not in before:
                    before[other] = at
                    front.append(other)
        if second not in before:
            return None
        way = [second]
        while way[-1] != first:
            way.append(before[way[-1]])
        return way[::-1]


def largest(residuals: Iterable[Array]) -> tuple[float, float]:
    """The largest translation [m] and rotation [rad] of twists (6,)."""
    found = list(residuals)
    moved = max((float(np.linalg.norm(r[:3])) for r in found), default=0.0)
    return moved, max((float(np.linalg.norm(r[3:])) for r in found), default=0.0)


def _noise(covariance: Array) -> gtsam.noiseModel.Base:
    """gtsam's twists have the rotation first."""
    order = [3, 4, 5, 0, 1, 2]
    return gtsam.noiseModel.Gaussian.Covariance(covariance[np.ix_(order, order)])


def _orthonormal(T: Array) -> Array:
    """The nearest pose with an exact rotation (polar decomposition)."""
    U, _, Vt = np.linalg.svd(T[:3, :3])
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = U @ Vt, T[:3, 3]
    return out

"""Pose graph of the keyframes: measured relative motions as edges, and the poses that fit all of them best."""

from __future__ import annotations

from collections import deque
from collections.abc import Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, field
from itertools import pairwise
from typing import Any

import gtsam
import numpy as np
from numpy.typing import NDArray

from splatbot.geometry import inverse, nearest_rotation, rotation_angles, se3_log
from splatbot.tracking.nearby_keyframes import pose_distance

Array = NDArray[np.float64]
Adjacency = Mapping[int, tuple[int, ...]]

_CAUCHY_SIGMA = 1.0  # scale of the Cauchy loss of loop edges [σ]
_COVISIBLE_CAUCHY_SIGMA = 3.0  # the same of covisible pairs; six residuals of 1 σ have the norm 2.4
NEIGHBOR_HOPS = 10  # keyframes along the path within which places are neighbors, and not revisited
_OPEN_TRANSLATION, _OPEN_ROTATION = 1e-2, 2e-2  # [m], [rad] residual above which a revisited place is not closed
_DRIFT_SIGMA = 5e-3  # standard deviation of the odometry error, relative to the motion [m/m], [rad/rad]
# Least covariance of an edge: standard deviations of 1 mm and 0.5 mrad, however small the residuals of its alignment.
_LEAST_COVARIANCE = np.diag([1e-3**2] * 3 + [5e-4**2] * 3)


@dataclass(frozen=True)
class Edge:
    """A measured motion between two keyframes.

    Args:
        first, second: their numbers.
        T_first_second: (4, 4).
        covariance: (6, 6) of the twist (t [m], ω [rad]) in the second camera's frame.
        loop: whether it is a loop closure, which may be wrong.
        covisible: whether it is one of many measurements of the same keyframes, so that a wrong one shows.
        pair: whether it is one of the covisible pairs of bundle adjustment, and not of the path that was tracked.
    """

    first: int
    second: int
    T_first_second: Array
    covariance: Array
    loop: bool = False
    covisible: bool = False
    pair: bool = False

    def residual(self, poses: Mapping[int, Array]) -> Array:
        """Compute the twist (6,) from the measured to the estimated motion, in the second camera's frame.

        r = log(T_first_second⁻¹ · T_first⁻¹ · T_second), the residual of a between factor.
        """
        T = inverse(poses[self.first]) @ poses[self.second]
        return se3_log(inverse(self.T_first_second) @ T)


@dataclass
class PoseGraph:
    """Poses T_world_camera (4, 4) by keyframe number, and the edges between them."""

    poses: dict[int, Array] = field(default_factory=dict)
    edges: list[Edge] = field(default_factory=list)

    def adjacency(self, *, revisits: bool = True) -> Adjacency:
        """Return the neighbors of each keyframe along the tracked path and, with ``revisits``, by revisited places.

        Loop closures connect a revisited place, and so do pairs of keyframes far apart in time that the poses agree
        with. Pairs of keyframes near in time would only shorten the path along which drift adds up.
        """
        counted = [edge for edge in self.edges if not (edge.loop or edge.pair)]
        if revisits:
            far = [edge for edge in self.edges if edge.pair and abs(edge.second - edge.first) > NEIGHBOR_HOPS]
            counted += [edge for edge in self.edges if edge.loop]
            counted += [edge for edge, closed in zip(far, self.closed(far), strict=True) if closed]
        found: dict[int, list[int]] = {number: [] for number in self.poses}
        for edge in counted:
            found.setdefault(edge.first, []).append(edge.second)
            found.setdefault(edge.second, []).append(edge.first)
        return {number: tuple(others) for number, others in found.items()}

    def path_length(self, first: int, second: int) -> tuple[float, float]:
        """Compute translation [m] and rotation [rad] summed over the path with the fewest odometry edges.

        Both are infinite if no path connects the two keyframes.
        """
        path = self._path(first, second)
        if path is None:
            return np.inf, np.inf
        steps = [se3_log(inverse(self.poses[a]) @ self.poses[b]) for a, b in pairwise(path)]
        return (
            float(sum(np.linalg.norm(step[:3]) for step in steps)),
            float(sum(np.linalg.norm(step[3:]) for step in steps)),
        )

    def closed(self, edges: Sequence[Edge]) -> NDArray[np.bool_]:
        """Return with which edges (E,) the poses agree, within the accuracy of a closed loop."""
        if not edges:
            return np.zeros(0, np.bool_)
        first, second = (np.stack([self.poses[getattr(e, end)] for e in edges]) for end in ("first", "second"))
        T = np.asarray(np.linalg.solve(first @ np.stack([e.T_first_second for e in edges]), second), np.float64)
        moved = np.linalg.norm(T[:, :3, 3], axis=1)
        return np.asarray((moved < _OPEN_TRANSLATION) & (rotation_angles(T[:, :3, :3]) < _OPEN_ROTATION))

    def optimize(self, free: Set[int] | None = None, *, pairs: bool = True) -> dict[int, Array]:
        """Compute the poses that minimize the cost of all edges; the first keyframe is fixed.

        min Σ_odometry ½ ‖r_ij‖²_Σij + Σ_robust ρ(‖r_ij‖_Σij), with the residual r of :meth:`Edge.residual`. The squared
        Mahalanobis norm is ‖r‖²_Σ = rᵀ Σ⁻¹ r. Loops and covisible pairs have the Cauchy loss
        ρ(x) = c² / 2 · log(1 + x² / c²). GTSAM solves it by Levenberg-Marquardt on SE(3) (Dellaert & Kaess 2017,
        Factor Graphs for Robot Perception).

        Args:
            free: keyframes that may move; the others are fixed. If None, all but the first may move.
            pairs: with the covisible pairs of bundle adjustment. Without them, the tracked path alone takes up the
                error of a loop: pairs share the errors of lens and shutter, so that many of them are too stiff.

        Returns:
            T_world_camera (4, 4) of all keyframes, or of the free ones and their neighbors.
        """
        first = min(self.poses)
        edges = [e for e in self.edges if pairs or not e.pair]
        edges = [e for e in edges if free is None or e.first in free or e.second in free]
        numbers = {first, *self.poses} if free is None else {n for e in edges for n in (e.first, e.second)}
        values = gtsam.Values()
        for number in sorted(numbers):
            values.insert(number, gtsam.Pose3(self.poses[number]))
        fixed = {n for n in numbers if n == first or (free is not None and n not in free)}
        graph = self._factors(edges, fixed, robust_path=pairs)
        values = gtsam.LevenbergMarquardtOptimizer(graph, values).optimize()
        return {number: orthonormal(values.atPose3(number).matrix()) for number in sorted(numbers)}

    def _factors(self, edges: list[Edge], fixed: set[int], *, robust_path: bool) -> Any:
        """Return the factors of edges and of fixed keyframes."""
        graph, cauchy = gtsam.NonlinearFactorGraph(), gtsam.noiseModel.mEstimator.Cauchy
        for number in sorted(fixed):
            noise = _noise_model(1e-8 * np.eye(6))
            graph.add(gtsam.PriorFactorPose3(number, gtsam.Pose3(self.poses[number]), noise))
        for edge in edges:
            noise = _noise_model(edge.covariance + _LEAST_COVARIANCE)
            if edge.loop or (edge.covisible and robust_path):
                sigma = _CAUCHY_SIGMA if edge.loop else _COVISIBLE_CAUCHY_SIGMA
                noise = gtsam.noiseModel.Robust.Create(cauchy.Create(sigma), noise)
            graph.add(gtsam.BetweenFactorPose3(edge.first, edge.second, gtsam.Pose3(edge.T_first_second), noise))
        return graph

    def _path(self, first: int, second: int) -> list[int] | None:
        """Find the path with the fewest odometry edges by breadth-first search."""
        adjacency = self.adjacency(revisits=False)
        parent: dict[int, int] = {first: first}
        queue = deque([first])
        while queue and second not in parent:
            number = queue.popleft()
            for other in adjacency.get(number, ()):
                if other not in parent:
                    parent[other] = number
                    queue.append(other)
        if second not in parent:
            return None
        path = [second]
        while path[-1] != first:
            path.append(parent[path[-1]])
        return path[::-1]


def within_hops(adjacency: Adjacency, number: int, hops: int) -> set[int]:
    """Return the keyframes at most ``hops`` edges away from one, including it."""
    found, queue = {number}, deque([(number, 0)])
    while queue:
        at, distance = queue.popleft()
        for other in adjacency.get(at, ()) if distance < hops else ():
            if other not in found:
                found.add(other)
                queue.append((other, distance + 1))
    return found


def max_residual(residuals: Iterable[Array]) -> tuple[float, float]:
    """Compute the largest translation [m] and rotation [rad] of twists (6,)."""
    found = list(residuals)
    moved = max((float(np.linalg.norm(r[:3])) for r in found), default=0.0)
    return moved, max((float(np.linalg.norm(r[3:])) for r in found), default=0.0)


def drift_covariance(T: Array) -> Array:
    """Compute the covariance (6, 6) of the odometry error, which grows with the motion (4, 4).

    σ_t = s (‖t‖ + θ · 1 m) and σ_ω = s θ, with s = 0.5 %: errors of lens and depth calibration add up over the path.
    """
    moved, turned = pose_distance(np.eye(4), T)
    return np.diag([(_DRIFT_SIGMA * (moved + turned)) ** 2] * 3 + [(_DRIFT_SIGMA * turned) ** 2] * 3)


def _noise_model(covariance: Array) -> gtsam.noiseModel.Base:
    """Convert a covariance (6, 6); GTSAM's twists begin with the rotation."""
    order = [3, 4, 5, 0, 1, 2]
    return gtsam.noiseModel.Gaussian.Covariance(covariance[np.ix_(order, order)])


def orthonormal(T: Array) -> Array:
    """Return the nearest pose (4, 4) with an exact rotation."""
    out = np.eye(4)
    out[:3, :3], out[:3, 3] = nearest_rotation(T[:3, :3]), T[:3, 3]
    return out

"""Loop closing: places seen again are recognized, verified against the images and closed in the pose graph."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from splatbot.config import Config
from splatbot.geometry import inverse
from splatbot.mapping.bundle import adjust
from splatbot.mapping.covisibility import covisible_candidates
from splatbot.mapping.keyframes import Keyframe
from splatbot.mapping.observation import GraphLocation, Observation
from splatbot.mapping.posegraph import (
    NEIGHBOR_HOPS,
    Adjacency,
    Edge,
    PoseGraph,
    drift_covariance,
    max_residual,
    orthonormal,
    within_hops,
)
from splatbot.tracking.align import align
from splatbot.tracking.features import match_pose
from splatbot.tracking.health import measure
from splatbot.tracking.nearby_keyframes import is_within, order_by_distance, pose_distance
from splatbot.tracking.place_recognition import votes
from splatbot.tracking.prepare import PreparedFrame
from splatbot.tracking.uncertainty import alignment_covariance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class LoopConstants:
    """Constants of loop closing."""

    near: tuple[float, float] = (0.25, 0.35)
    """Distance [m] and angle [rad] within which a keyframe is a loop candidate, even with another appearance."""
    appearance_candidates: int = 2
    """Number of loop candidates [1] by appearance that are verified for each keyframe. Each takes an alignment."""
    unknown_sigma: float = 0.5
    """Standard deviation [m], [rad] of a motion that the images could not measure."""
    tracking: tuple[float, float] = (5e-3, 5e-3)
    """Distance [m] and angle [rad] up to which the images confirm the tracked motion between two keyframes. Beyond it,
    other keyframes biased tracking."""
    drift_offset: float = 0.05
    """Drift [m], [rad] that a loop may correct for a path of any length."""
    same: tuple[float, float] = (0.02, 0.02)
    """Distance [m] and angle [rad] between the corrections of two loops, within which they confirm each other."""
    unconfirmed_kept: int = 4
    """Number of loops [1] that wait for a confirming one. More of them confirm loops that are farther apart in time."""
    ratios_kept: int = 10
    """Number of latest keyframes [1] whose pairs measure the consistency of images. More of them react more slowly."""


CONSTANTS = LoopConstants()


@dataclass(frozen=True)
class MeasuredMotion:
    """The motion from a keyframe to a frame, measured from the images of these two alone.

    Args:
        T_keyframe_camera: (4, 4); ``covariance`` (6, 6) of its twist in the camera frame.
        overlap, inliers: shares of the keyframe's points that the frame observes, and of those that agree.
        matches: number of features that agree.
    """

    T_keyframe_camera: Array
    covariance: Array
    overlap: float
    inliers: float
    matches: int

    def agrees(self, T_tracked: Array) -> bool:
        """Return whether it equals the tracked motion (4, 4) within the accuracy of an alignment."""
        moved, turned = pose_distance(T_tracked, self.T_keyframe_camera)
        return moved <= CONSTANTS.tracking[0] and turned <= CONSTANTS.tracking[1]


class LoopCloser:
    """Builds the pose graph and computes how keyframes have to move once a place has been seen again.

    It accepts a loop closure under three conditions. Features and images of two keyframes agree. The loop implies no
    more drift than the path between them explains. The optimized graph is consistent with it.

    A loop that differs from the tracked poses needs a second loop that implies the same correction, because repeated
    texture looks alike.

    The mapping thread owns all of its state. The tracking thread calls :meth:`locate`, which reads ``adjacency``; that
    mapping is replaced by assignment and never changed.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        self.graph = PoseGraph()
        self.adjacency: Adjacency = {}
        """Numbers of the neighbors of each keyframe in the pose graph."""
        self.correction: dict[int, Array] | None = None
        """T_new_old (4, 4) by keyframe number once a loop is closed; None otherwise."""
        self.closed = 0
        self.rejected = 0
        self.inconsistency = 1.0
        """Ratio of the observed to the stated variance of measured motions, at least 1."""
        self._ratios: list[float] = []
        self._unconfirmed: list[Edge] = []

    def locate(self, T_world_camera: Array, keyframes: Sequence[Keyframe], previous: GraphLocation) -> GraphLocation:
        """Return where a frame is in the pose graph.

        The reference keyframe follows the nearest keyframe while that is a neighbor of the previous one. A nearest
        keyframe outside the neighborhood is a revisited place.

        Args:
            T_world_camera: (4, 4) of the frame.
            previous: location of the previous frame.
        """
        if not self.config.loops.enabled or not keyframes:
            return GraphLocation()
        nearest = keyframes[order_by_distance(keyframes, T_world_camera)[0]].number
        if previous.keyframe is None or abs(nearest - previous.keyframe) <= NEIGHBOR_HOPS:
            return GraphLocation(nearest)
        adjacency = self.adjacency
        if previous.keyframe not in adjacency:  # submitted, and not in the graph yet
            return GraphLocation(previous.keyframe)
        revisits = nearest not in within_hops(adjacency, previous.keyframe, NEIGHBOR_HOPS)
        if revisits and nearest in adjacency:
            return GraphLocation(previous.keyframe, revisits=True)
        return GraphLocation(nearest)

    def add(self, keyframe: Keyframe, observation: Observation, keyframes: Sequence[Keyframe]) -> None:
        """Add a keyframe and its odometry edges to the graph, and search for loop closures.

        Args:
            keyframe: the new one, made of ``observation``.
            keyframes: all, including the new one.
        """
        if not self.config.loops.enabled:
            return
        self.graph.poses[keyframe.number] = keyframe.T_world_camera
        self._add_edges(keyframe, observation, keyframes)
        self.adjacency = self.graph.adjacency()

    def apply_correction(self, correction: Mapping[int, Array]) -> None:
        """Move the poses of the graph after the keyframes were moved.

        The rotations stay exact: the rounding errors of many corrections would otherwise grow exponentially.
        """
        self.graph.poses = {number: orthonormal(correction[number] @ T) for number, T in self.graph.poses.items()}
        self.correction = None

    def state(self) -> dict[str, Any]:
        """Return the state for :meth:`restore`, by reference; containers are copied."""
        state = {name: _shallow_copy(value) for name, value in vars(self).items() if name not in ("config", "graph")}
        return state | {"graph": PoseGraph(dict(self.graph.poses), list(self.graph.edges))}

    def restore(self, state: Mapping[str, Any]) -> None:
        """Go back to an earlier :meth:`state`."""
        vars(self).update(state)

    def _add_edges(self, keyframe: Keyframe, observation: Observation, keyframes: Sequence[Keyframe]) -> None:
        keyframes = [k for k in keyframes if k.number in self.graph.poses]  # later ones are added in their turn
        others = [k for k in keyframes if k is not keyframe]
        if not others:
            return
        reference = next((k for k in others if k.number == observation.location.keyframe), others[-1])
        if self.correction is not None:  # the loop was found earlier: the keyframe moves with its reference
            self.correction[keyframe.number] = self.correction[reference.number]
        prepared = observation.prepared
        odometry = self._odometry_edge(reference, keyframe, prepared)
        covisible = self._covisible_edges(keyframe, others, prepared)
        if not self.graph.closed([odometry]).all():  # tracking went over to a place seen before: a loop to be closed
            covisible = [pair for pair in covisible if keyframe.number - pair.first <= NEIGHBOR_HOPS]
        if any(keyframe.number - pair.first <= NEIGHBOR_HOPS for pair in covisible):
            odometry = replace(odometry, covisible=True)  # its neighbors show whether it is wrong
        self.graph.edges += [odometry, *covisible]
        edge = None if others[-1] is reference else self._covisibility_edge(others[-1], keyframe, prepared)
        if edge is not None:
            self.graph.edges.append(edge)
        T_world_odometry = reference.T_world_camera @ odometry.T_first_second
        candidates = self._loop_candidates(reference, keyframe, keyframes)
        loops = [loop for other in candidates if (loop := self._loop_edge(other, keyframe, prepared, T_world_odometry))]
        confirmed = [edge for edge in loops if self._is_confirmed(edge)]
        self._unconfirmed = [*self._unconfirmed[-CONSTANTS.unconfirmed_kept :], *loops]
        if confirmed:
            self._close(confirmed)
        if self.correction is None and covisible:
            self._adjust(keyframe.number)

    def _covisible_edges(self, keyframe: Keyframe, others: Sequence[Keyframe], prepared: PreparedFrame) -> list[Edge]:
        """Return the motions from covisible keyframes, each measured from the images of the two alone."""
        if not self.config.bundle.enabled:
            return []
        edges = []
        for other in covisible_candidates(keyframe, others, self.config.bundle.pairs):
            measured = self._measure(other, keyframe, prepared)
            if measured is not None and self._is_reliable(measured) and measured.matches > 0:
                T = measured.T_keyframe_camera
                moved, turned = pose_distance(inverse(other.T_world_camera) @ keyframe.T_world_camera, T)
                if max(moved, turned) > CONSTANTS.drift_offset:  # repeated texture, or a loop to be confirmed
                    self.rejected += 1
                    continue
                covariance = measured.covariance + drift_covariance(T)
                edges.append(Edge(other.number, keyframe.number, T, covariance, covisible=True, pair=True))
        return edges

    def _adjust(self, number: int) -> None:
        """Adjust the poses to all covisible pairs, see :func:`splatbot.mapping.bundle.adjust`."""
        adjustment = adjust(self.graph, number, self.config.bundle)
        self.correction = adjustment.correction
        if adjustment.variance_ratio is not None:
            self._ratios = [*self._ratios, adjustment.variance_ratio][-CONSTANTS.ratios_kept :]
            self.inconsistency = max(1.0, float(np.median(self._ratios)))

    def _odometry_edge(self, reference: Keyframe, keyframe: Keyframe, prepared: PreparedFrame) -> Edge:
        """Return the motion from the reference keyframe: as tracked, or as measured where other keyframes biased it."""
        T_tracked = inverse(reference.T_world_camera) @ keyframe.T_world_camera
        measured = self._measure(reference, keyframe, prepared)
        if measured is None or not self._is_reliable(measured):
            near = is_within(pose_distance(np.eye(4), T_tracked), CONSTANTS.near, times=2)
            covariance = drift_covariance(T_tracked) if near else CONSTANTS.unknown_sigma**2 * np.eye(6)
            return Edge(reference.number, keyframe.number, T_tracked, covariance)
        T = T_tracked if measured.agrees(T_tracked) else measured.T_keyframe_camera
        return Edge(reference.number, keyframe.number, T, measured.covariance + drift_covariance(T))

    def _covisibility_edge(self, latest: Keyframe, keyframe: Keyframe, prepared: PreparedFrame) -> Edge | None:
        """Return the motion from the previous keyframe, if that is not the reference and the images confirm the motion.

        Without this edge, two chains of keyframes would alternate, and the drift between them would appear as a loop.
        """
        T_tracked = inverse(latest.T_world_camera) @ keyframe.T_world_camera
        measured = self._measure(latest, keyframe, prepared)
        if measured is None or not self._is_reliable(measured) or not measured.agrees(T_tracked):
            return None
        return Edge(latest.number, keyframe.number, T_tracked, measured.covariance + drift_covariance(T_tracked))

    def _loop_candidates(
        self, reference: Keyframe, keyframe: Keyframe, keyframes: Sequence[Keyframe]
    ) -> list[Keyframe]:
        """Return keyframes that may show the same place although no short chain of edges leads there."""
        hops = NEIGHBOR_HOPS
        neighbors = within_hops(self.graph.adjacency(), reference.number, hops)
        others = [k for k in keyframes if k.number not in neighbors and abs(k.number - keyframe.number) > hops]
        if not others:
            return []
        nearest = others[order_by_distance(others, keyframe.T_world_camera)[0]]
        near = is_within(pose_distance(nearest.T_world_camera, keyframe.T_world_camera), CONSTANTS.near)
        found = [nearest] if near else []
        count = votes(keyframe.features, others)
        for index in np.argsort(-count, kind="stable")[: CONSTANTS.appearance_candidates]:
            if count[index] >= self.config.loops.min_votes and others[index] not in found:
                found.append(others[index])
        return found

    def _loop_edge(
        self, candidate: Keyframe, keyframe: Keyframe, prepared: PreparedFrame, T_world_odometry: Array
    ) -> Edge | None:
        """Return the motion from a loop candidate, if the images confirm it and the implied drift is possible.

        Args:
            T_world_odometry: (4, 4), the keyframe's pose by its odometry edge alone.
        """
        limits = self.config.loops
        measured = self._measure(candidate, keyframe, prepared)
        if measured is None or not self._is_reliable(measured) or measured.matches < limits.min_matches:
            return None
        T_odometry = inverse(candidate.T_world_camera) @ T_world_odometry
        moved, turned = pose_distance(T_odometry, measured.T_keyframe_camera)
        length, rotation = self.graph.path_length(candidate.number, keyframe.number)
        offset = CONSTANTS.drift_offset
        if moved > offset + limits.max_drift * length or turned > offset + limits.max_drift * rotation:
            self.rejected += 1
            return None
        T = measured.T_keyframe_camera
        return Edge(candidate.number, keyframe.number, T, measured.covariance + drift_covariance(T), loop=True)

    def _is_confirmed(self, edge: Edge) -> bool:
        """Return whether a loop agrees with the tracked poses, or another loop implies the same correction."""
        poses = self.graph.poses
        if is_within(max_residual([edge.residual(poses)]), CONSTANTS.tracking, times=2):
            return True
        T_world_camera = poses[edge.second]
        expected = poses[edge.first] @ edge.T_first_second
        for other in self._unconfirmed:
            correction = poses[other.first] @ other.T_first_second @ inverse(poses[other.second])
            same = is_within(pose_distance(expected, correction @ T_world_camera), CONSTANTS.same)
            if other.second != edge.second and same:
                return True
        return False

    def _close(self, loops: list[Edge]) -> None:
        """Optimize the graph with new loop edges; keep them if all measured motions remain consistent."""
        self.graph.edges += loops
        limits = self.config.loops
        moved, turned = max_residual(edge.residual(self.graph.poses) for edge in self.graph.edges)
        if moved < limits.min_translation and turned < limits.min_rotation:
            self.closed += 1
            return
        poses = self.graph.optimize(pairs=False)
        is_open = not PoseGraph(poses).closed(loops).all()
        measured = (edge for edge in self.graph.edges if not (edge.loop or edge.pair))
        sigma = max((_mahalanobis(edge, poses) for edge in measured), default=0.0)
        if is_open or sigma > limits.max_edge_sigma:
            self.graph.edges = [edge for edge in self.graph.edges if all(edge is not loop for loop in loops)]
            self.rejected += len(loops)
            return
        self.closed += 1
        self.graph.edges = [edge for edge in self.graph.edges if not edge.pair]  # they share the error that it reveals
        self.correction = {k: orthonormal(poses[k] @ inverse(T)) for k, T in self.graph.poses.items()}

    def _measure(self, other: Keyframe, keyframe: Keyframe, prepared: PreparedFrame) -> MeasuredMotion | None:
        """Align the frame of a keyframe to one other keyframe; return None if the alignment does not converge."""
        config, levels = self.config.tracking, prepared.levels
        camera, gate = prepared.frame.camera, config.sensor.max_depth_difference
        T_world_other = other.reference.T_world_camera
        matched = match_pose(keyframe.features, [(other.features, T_world_other)], camera)
        start = matched.T_world_camera if matched is not None else keyframe.T_world_camera
        reference = [other.reference]
        coarse = align(
            levels,
            reference,
            start,
            config,
            photometric=False,
            finest=min(1, len(levels) - 1),
            gate=2 * gate,
        )
        found = align(
            levels,
            reference,
            coarse.T_world_camera if matched is None else start,
            config,
            photometric=True,
            finest=0,
            gate=gate,
            features=matched,
            camera=camera,
        )
        index = min(1, len(levels) - 1)
        health = measure(levels[index], index, reference, found.T_world_camera, config)
        covariance = alignment_covariance(found)
        if not np.isfinite(covariance).all() or not np.isfinite(found.T_world_camera).all():
            return None
        return MeasuredMotion(
            T_keyframe_camera=inverse(T_world_other) @ found.T_world_camera,
            covariance=covariance,
            overlap=health.overlap,
            inliers=min(health.photometric_inliers, health.geometric_inliers),
            matches=0 if matched is None else len(matched.points),
        )

    def _is_reliable(self, found: MeasuredMotion) -> bool:
        return found.overlap >= self.config.loops.min_overlap and found.inliers >= self.config.loops.min_inliers


def _shallow_copy(value: Any) -> Any:
    """Return a shallow copy of a list or dict, other values as they are."""
    return value.copy() if isinstance(value, list | dict) else value


def _mahalanobis(edge: Edge, poses: Mapping[int, Array]) -> float:
    """Compute the Mahalanobis distance √(rᵀ Σ⁻¹ r) of an edge's residual [σ]."""
    residual = edge.residual(poses)
    return float(np.sqrt(residual @ np.linalg.solve(edge.covariance + 1e-6 * np.eye(6), residual)))

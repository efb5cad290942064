"""Places seen again: recognised, verified against the images, and the map's pieces moved so that they meet."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.config import Config
from splatbot.gaussians import GaussianModel
from splatbot.geometry import inverse, quat_multiply, rotation_to_quat
from splatbot.mapping.keyframes import Keyframe
from splatbot.mapping.posegraph import Edge, PoseGraph, largest
from splatbot.tracking.align import align
from splatbot.tracking.features import Features, match_pose
from splatbot.tracking.health import measure
from splatbot.tracking.nearby_keyframes import order_by_distance, pose_distance
from splatbot.tracking.place_recognition import votes
from splatbot.tracking.prepare import PreparedFrame
from splatbot.tracking.uncertainty import alignment_covariance

Array = NDArray[np.float64]

_NEIGHBOURS = 10  # edges of the graph within which a keyframe is no place seen again
_NEAR = 0.25, 0.35  # [m], [rad]: a keyframe so near is a candidate although it may look different
_TRIED = 2  # candidates by looks that are verified for a keyframe
_UNKNOWN = np.diag([0.5**2] * 3 + [0.5**2] * 3)  # covariance of a motion that could not be measured
# Lens and depth are calibrated to this share: over a long way the error adds up [1].
_CALIBRATION = 5e-3
# A loop that the solved graph leaves more open than this is wrong [m], [rad].
_OPEN = 1e-2, 2e-2
_JUMP = 5e-3, 5e-3  # [m], [rad]: a keyframe was moved so far by its other neighbours; its own motion is measured


@dataclass(frozen=True)
class MeasuredMotion:
    """The motion from a keyframe to a view by the images of these two alone.

    Args:
        T_keyframe_camera: (4, 4); ``covariance`` (6, 6) of its twist in the camera's frame.
        overlap, inliers: shares of the keyframe's points that the view sees, and of those that agree.
        matches: features that agree.
    """

    T_keyframe_camera: Array
    covariance: Array
    overlap: float
    inliers: float
    matches: int

    def agrees(self, T_tracked: Array) -> bool:
        """Whether it is the motion (4, 4) that was tracked, but for what alignments differ by."""
        moved, turned = pose_distance(T_tracked, self.T_keyframe_camera)
        return moved <= _JUMP[0] and turned <= _JUMP[1]


@dataclass(frozen=True)
class LoopView:
    """A frame at T_world_camera (4, 4), with its features, and the keyframe that it was tracked by before."""

    prepared: PreparedFrame
    T_world_camera: Array
    features: Features
    anchor: int | None


class LoopCloser:
    """Keeps the pose graph; says how keyframes are to be moved once a place has been seen again.

    A loop is believed when features and images of two keyframes agree, when it asks for no more drift than the way
    between them explains, and when the graph can be solved with it. What only looks alike (repeated texture) needs a
    second one that says the same.
    """

    def __init__(self, config: Config) -> None:
        self.config = config
        self.graph = PoseGraph()
        self.anchor: int | None = None
        """The keyframe that the last frame was nearest to."""
        self.correction: dict[int, Array] | None = None
        """T_new_old (4, 4) by keyframe number: where they are to be moved; None: nowhere."""
        self.closed = 0
        self.rejected = 0
        self._suspected: list[Edge] = []

    def is_bridge(self, T_world_camera: Array, keyframes: Sequence[Keyframe]) -> bool:
        """Whether a frame has come upon a place seen before; keeps account of which keyframe frames are near to."""
        if not self.config.loops.enabled or not keyframes:
            return False
        nearest = keyframes[order_by_distance(keyframes, T_world_camera)[0]].number
        if self.anchor is None or nearest == self.anchor or abs(nearest - self.anchor) <= _NEIGHBOURS:
            self.anchor = nearest
        elif nearest in self.graph.poses and nearest not in self.graph.near(self.anchor, _NEIGHBOURS):
            return True
        else:
            self.anchor = nearest
        return False

    def add(self, keyframe: Keyframe, view: LoopView, keyframes: Sequence[Keyframe]) -> None:
        """A keyframe was made of a view: measure its motion, and look for places seen before."""
        if not self.config.loops.enabled:
            return
        self.graph.poses[keyframe.number] = keyframe.T_world_camera
        keyframes = [k for k in keyframes if k.number in self.graph.poses]  # later ones have their turn
        others = [k for k in keyframes if k is not keyframe]
        anchor = next((k for k in others if k.number == view.anchor), others[-1] if others else None)
        self.anchor = keyframe.number
        if anchor is None:
            return
        if self.correction is not None:  # it came after the loop, and moves with its neighbour
            self.correction[keyframe.number] = self.correction[anchor.number]
        step = self._odometry(anchor, keyframe, view)
        self.graph.edges.append(step)
        if others[-1] is not anchor and (tie := self._tie(others[-1], keyframe, view)) is not None:
            self.graph.edges.append(tie)
        T_chain = anchor.T_world_camera @ step.T_first_second
        strangers = self._strangers(anchor, keyframe, keyframes)
        loops = [edge for stranger in strangers if (edge := self._loop(stranger, keyframe, view, T_chain)) is not None]
        confirmed = [edge for edge in loops if self._is_confirmed(edge)]
        self._suspected = [*self._suspected[-4:], *loops]
        if confirmed:
            self._close(confirmed)

    def moved(self, correction: Mapping[int, Array]) -> None:
        """The keyframes were moved."""
        self.graph.poses = {number: correction[number] @ T for number, T in self.graph.poses.items()}
        self.correction = None

    def _odometry(self, anchor: Keyframe, keyframe: Keyframe, view: LoopView) -> Edge:
        """The motion from the last neighbour: as tracked, unless the tracker was drawn away by other keyframes."""
        T_tracked = inverse(anchor.T_world_camera) @ keyframe.T_world_camera
        found = self._measure(anchor, view)
        if found is None or not self._is_good(found):
            near = pose_distance(np.eye(4), T_tracked)
            known = near[0] < 2 * _NEAR[0] and near[1] < 2 * _NEAR[1]
            return Edge(anchor.number, keyframe.number, T_tracked, _drift(T_tracked) if known else _UNKNOWN)
        T = T_tracked if found.agrees(T_tracked) else found.T_keyframe_camera
        return Edge(anchor.number, keyframe.number, T, found.covariance + _drift(T))

    def _tie(self, latest: Keyframe, keyframe: Keyframe, view: LoopView) -> Edge | None:
        """The motion from the keyframe before, which was not there yet, or is farther, when the frame was tracked.

        Each keyframe with the last but one only would make two chains beside each other, and what they drift apart
        would be taken for a loop. None where their images say something else, for then one of the motions is wrong.
        """
        T_tracked = inverse(latest.T_world_camera) @ keyframe.T_world_camera
        found = self._measure(latest, view)
        if found is None or not self._is_good(found) or not found.agrees(T_tracked):
            return None
        return Edge(latest.number, keyframe.number, T_tracked, found.covariance + _drift(T_tracked))

    def _strangers(self, anchor: Keyframe, keyframe: Keyframe, keyframes: Sequence[Keyframe]) -> list[Keyframe]:
        """Keyframes that may show the same place although no short chain of motions leads there."""
        known = self.graph.near(anchor.number, _NEIGHBOURS)
        others = [k for k in keyframes if k.number not in known and abs(k.number - keyframe.number) > _NEIGHBOURS]
        if not others:
            return []
        nearest = others[order_by_distance(others, keyframe.T_world_camera)[0]]
        moved, turned = pose_distance(nearest.T_world_camera, keyframe.T_world_camera)
        found = [nearest] if moved < _NEAR[0] and turned < _NEAR[1] else []
        count = votes(keyframe.features, others)
        for index in np.argsort(-count, kind="stable")[:_TRIED]:
            if count[index] >= self.config.loops.min_votes and others[index] not in found:
                found.append(others[index])
        return found

    def _loop(self, stranger: Keyframe, keyframe: Keyframe, view: LoopView, T_chain: Array) -> Edge | None:
        """The motion from a place seen before, if the images bear it out and the drift since then is possible.

        ``T_chain`` (4, 4) is where the keyframe is by its last neighbour alone.
        """
        found = self._measure(stranger, view)
        if found is None or not self._is_good(found) or found.matches < self.config.loops.min_matches:
            return None
        moved, turned = pose_distance(inverse(stranger.T_world_camera) @ T_chain, found.T_keyframe_camera)
        way, turns = self.graph.path(stranger.number, keyframe.number)
        limits = self.config.loops
        if moved > 0.05 + limits.max_drift * way or turned > 0.05 + limits.max_drift * turns:
            self.rejected += 1
            return None
        T = found.T_keyframe_camera
        return Edge(stranger.number, keyframe.number, T, found.covariance + _drift(T), loop=True)

    def _is_confirmed(self, edge: Edge) -> bool:
        """Whether a loop asks for no more than the tracker has believed by itself, or another asks for the same."""
        poses = self.graph.poses
        residual = edge.residual(poses)
        if np.linalg.norm(residual[:3]) < 2 * _JUMP[0] and np.linalg.norm(residual[3:]) < 2 * _JUMP[1]:
            return True
        wanted = poses[edge.first] @ edge.T_first_second @ inverse(poses[edge.second])
        for other in self._suspected:
            same = poses[other.first] @ other.T_first_second @ inverse(poses[other.second])
            at = poses[edge.second]
            moved, turned = pose_distance(wanted @ at, same @ at)
            if other.second != edge.second and moved < 0.02 and turned < 0.02:
                return True
        return False

    def _close(self, loops: list[Edge]) -> None:
        """Solve the graph with new loops; keep them if everything that was measured still holds."""
        self.graph.edges += loops
        limits = self.config.loops
        if largest(edge.residual(self.graph.poses) for edge in self.graph.edges)[0] < limits.min_translation and (
            largest(edge.residual(self.graph.poses) for edge in self.graph.edges)[1] < limits.min_rotation
        ):
            self.closed += 1
            return
        poses = self.graph.optimised()
        moved, turned = largest(edge.residual(poses) for edge in loops)
        strained = max(_strain(edge, poses) for edge in self.graph.edges if not edge.loop)
        if moved > _OPEN[0] or turned > _OPEN[1] or strained > limits.max_edge_sigma:
            self.graph.edges = [edge for edge in self.graph.edges if all(edge is not loop for loop in loops)]
            self.rejected += len(loops)
            return
        self.closed += 1
        self.correction = {number: poses[number] @ inverse(T) for number, T in self.graph.poses.items()}

    def _measure(self, keyframe: Keyframe, view: LoopView) -> MeasuredMotion | None:
        """Align a view to one keyframe; None where there is nothing to start from."""
        config, levels = self.config.tracking, view.prepared.levels
        camera = view.prepared.frame.camera
        T_world_keyframe = keyframe.reference.T_world_camera
        matched = match_pose(view.features, [(keyframe.features, T_world_keyframe)], camera)
        start = matched.T_world_camera if matched is not None else view.T_world_camera
        gate = config.sensor.max_depth_difference
        reference = [keyframe.reference]
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
            T_keyframe_camera=inverse(T_world_keyframe) @ found.T_world_camera,
            covariance=covariance,
            overlap=health.overlap,
            inliers=min(health.photometric_inliers, health.geometric_inliers),
            matches=0 if matched is None else len(matched.points),
        )

    def _is_good(self, found: MeasuredMotion) -> bool:
        return found.overlap >= self.config.loops.min_overlap and found.inliers >= self.config.loops.min_inliers


def move_gaussians(model: GaussianModel, correction: Mapping[int, Array]) -> GaussianModel:
    """A model whose Gaussians have been moved rigidly with the keyframes they are anchored to.

    Harmonics above degree 0 are not turned: the online map has none.
    """
    anchors = model.anchors.numpy()
    means, quats = model.means.numpy().astype(np.float64), model.quats.numpy().astype(np.float64)
    for number in np.unique(anchors):
        T = correction.get(int(number))
        if T is None:
            continue
        rows = anchors == number
        means[rows] = means[rows] @ T[:3, :3].T + T[:3, 3]
        quats[rows] = quat_multiply(rotation_to_quat(T[:3, :3][None]), quats[rows])
    return replace(
        model, means=torch.from_numpy(means.astype(np.float32)), quats=torch.from_numpy(quats.astype(np.float32))
    )


def move_keyframe(keyframe: Keyframe, correction: Mapping[int, Array]) -> Keyframe:
    """A keyframe, and what is aligned to it, at its new pose."""
    T = correction[keyframe.number] @ keyframe.T_world_camera
    return replace(keyframe, T_world_camera=T, reference=replace(keyframe.reference, T_world_camera=T))


def _drift(T: Array) -> Array:
    """Covariance (6, 6) of errors that grow with the motion."""
    moved, turned = pose_distance(np.eye(4), T)
    shift, turn = (_CALIBRATION * (moved + turned)) ** 2, (_CALIBRATION * turned) ** 2
    return np.diag([shift] * 3 + [turn] * 3)


def _strain(edge: Edge, poses: Mapping[int, Array]) -> float:
    """How far [σ] an edge is stretched."""
    residual = edge.residual(poses)
    return float(np.sqrt(residual @ np.linalg.solve(edge.covariance + 1e-6 * np.eye(6), residual)))

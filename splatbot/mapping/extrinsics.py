"""Extrinsics of a camera that is mounted on a known frame, estimated by aligning its frames to keyframes of the map."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from splatbot.config import Config
from splatbot.geometry import inverse, se3_exp, se3_log
from splatbot.mapping.keyframes import Keyframe
from splatbot.tracking.align import align
from splatbot.tracking.health import measure
from splatbot.tracking.nearby_keyframes import is_within, pose_distance
from splatbot.tracking.prepare import PreparedFrame, typical_depth
from splatbot.tracking.reference import Reference, ReferencePoints
from splatbot.tracking.uncertainty import alignment_covariance

Array = NDArray[np.float64]


@dataclass(frozen=True)
class ExtrinsicsConstants:
    """Constants of the estimation.

    Args:
        keyframes: largest number of keyframes that a frame is aligned to.
        rounds: largest number of alignments, each with the pixels that face the camera at the pose before.
        coarse_rounds: number of them by depth alone.
        converged: [m], [rad] change of the pose in one round at which it has converged.
        min_pixels: least number of sampled pixels that face the camera.
        min_cosine: cosine of the largest angle between the normal of a pixel and the direction to the camera.
        max_sigma: [m], [rad] standard deviation of a pose above which its view determines it too weakly.
        agreeing: frames, each aligned from another start, whose poses must agree.
        agreement: [m], [rad] distance of each of them from their mean.
        gate: [σ] distance from the given pose along each axis above which an estimate contradicts it.
    """

    keyframes: int = 8
    rounds: int = 12
    coarse_rounds: int = 3
    converged: tuple[float, float] = (2e-4, 2e-4)
    min_pixels: int = 500
    min_cosine: float = 0.1
    max_sigma: tuple[float, float] = (3e-3, 5e-3)
    agreeing: int = 8
    agreement: tuple[float, float] = (4e-3, 6e-3)
    gate: float = 5.0


CONSTANTS = ExtrinsicsConstants()

# Signs of the displaced starts along the six axes: seven columns of the Hadamard matrix of order 8 without the first.
_SIGNS = np.array([[(-1) ** bin(row & column).count("1") for column in range(1, 7)] for row in range(8)], np.float64)


@dataclass(frozen=True, eq=False)
class MeasuredPose:
    """Pose of one frame by its alignment to the map.

    Args:
        T_world_camera: (4, 4).
        covariance: (6, 6) of the twist (t [m], ω [rad]) in the camera's frame.
    """

    T_world_camera: Array
    covariance: Array


def locate_in_map(
    prepared: PreparedFrame, keyframes: Sequence[Keyframe], T_world_start: Array, config: Config
) -> MeasuredPose | str:
    """Align a frame to the keyframes that view the same place, until the pose converges.

    The alignment is :func:`splatbot.tracking.align.align`: first by depth alone, then with grey. A wide baseline turns
    surfaces away from the camera. Sampled pixels whose surface faces away are left out for each pose::

        n · p < 0 for the normal n and the point p of a pixel in the camera's frame

    Args:
        prepared: the frame.
        keyframes: those of the map.
        T_world_start: (4, 4) start.
        config: configuration of the camera.

    Returns:
        The pose, or the reason why the keyframes do not determine it.
    """
    levels, gate, T = prepared.levels, config.sensor.max_depth_difference, T_world_start
    near = viewing_same_place(keyframes, T, typical_depth(prepared))[: CONSTANTS.keyframes]
    for round_ in range(CONSTANTS.rounds):
        references = [_facing(keyframe.reference, T) for keyframe in near]
        if sum(len(reference.levels[0].points) for reference in references) < CONSTANTS.min_pixels:
            return "the map shows too little of its view"
        photometric = round_ >= CONSTANTS.coarse_rounds
        found = align(
            levels,
            references,
            T,
            config.tracking,
            photometric=photometric,
            finest=0 if photometric else min(1, len(levels) - 1),
            gate=gate if photometric else 2 * gate,
        )
        if not np.isfinite(found.T_world_camera).all():
            return "its images cannot be aligned to the map"
        T_before, T = T, found.T_world_camera
        if photometric and is_within(pose_distance(T_before, T), CONSTANTS.converged):
            return _checked(prepared, references, MeasuredPose(T, alignment_covariance(found)), config)
    return "its alignment to the map does not converge"


def _checked(
    prepared: PreparedFrame, references: Sequence[Reference], found: MeasuredPose, config: Config
) -> MeasuredPose | str:
    """Return the pose if the images confirm it and determine it in all directions, or else the reason."""
    index, limits = min(1, len(prepared.levels) - 1), config.loops
    health = measure(prepared.levels[index], index, references, found.T_world_camera, config.tracking)
    inliers = min(health.photometric_inliers, health.geometric_inliers)
    if health.overlap < limits.min_overlap or inliers < limits.min_inliers:
        return f"its images differ from the map: {health.overlap:.0%} overlap, {inliers:.0%} of the pixels agree"
    if not np.isfinite(found.covariance).all():
        return "its images do not determine its pose"
    moved, turned = (float(np.sqrt(np.linalg.eigvalsh(found.covariance[part, part])[-1])) for part in _PARTS)
    if moved > CONSTANTS.max_sigma[0] or turned > CONSTANTS.max_sigma[1]:
        sigma = f"σ {1e3 * moved:.1f} mm, {np.degrees(turned):.2f}°"
        return f"its view of the map determines its pose too weakly ({sigma})"
    return found


_PARTS = (slice(0, 3), slice(3, 6))  # translation and rotation of a twist


def _facing(reference: Reference, T_world_camera: Array) -> Reference:
    """Return a reference without the pixels whose surface faces away from a camera, by the angle of its normal."""
    T = inverse(T_world_camera) @ reference.T_world_camera
    levels = []
    for level in reference.levels:
        points, normals = level.points @ T[:3, :3].T + T[:3, 3], level.normals @ T[:3, :3].T
        seen = np.einsum("ij,ij->i", points, normals) < -CONSTANTS.min_cosine * np.linalg.norm(points, axis=1)
        levels.append(ReferencePoints(level.points[seen], level.normals[seen], level.gray[seen], level.slope[seen]))
    return Reference(reference.T_world_camera, tuple(levels))


def viewing_same_place(keyframes: Sequence[Keyframe], T_world_camera: Array, depth: float) -> list[Keyframe]:
    """Return keyframes in the order of the distance between the places that they and a camera view.

    Args:
        keyframes: of one or more cameras.
        T_world_camera: (4, 4) pose of the camera.
        depth: distance [m] of the place along the optical axis of either camera.
    """
    ahead = np.array([0.0, 0.0, depth, 1.0])
    place = T_world_camera @ ahead
    return sorted(keyframes, key=lambda k: float(np.linalg.norm(k.T_world_camera @ ahead - place)))


@dataclass
class ConstantPose:
    """Pose of a camera on its parent frame: given, or estimated from frames that agree.

    Each frame starts at another displacement of the given pose by one σ along every axis. The pose is known once the
    latest eight that could be aligned agree within ``CONSTANTS.agreement``. A pose beyond 5 σ of the given one is
    refused.

    Args:
        T_parent_camera: (4, 4) given pose, and the estimate once it is known.
        sigma: standard deviations of the given translation [m] and rotation [rad]; (0, 0) is exact.
        known: whether frames have a pose.
        covariance: (6, 6) of the twist (t [m], ω [rad]) in the camera's frame.
        reason: why the pose is not known.
        measured: the latest measured poses on the parent.
        tried: number of frames that were aligned.
    """

    T_parent_camera: Array
    sigma: tuple[float, float]
    known: bool = False
    covariance: Array = field(default_factory=lambda: np.zeros((6, 6)))
    reason: str = "its pose is not estimated yet"
    measured: list[MeasuredPose] = field(default_factory=list)
    tried: int = 0

    def __post_init__(self) -> None:
        self.known = self.known or self.is_exact

    def start(self) -> Array:
        """Return the start (4, 4) on the parent for the next frame."""
        displacement = _SIGNS[self.tried % len(_SIGNS)] * np.repeat(self.sigma, 3)
        return np.asarray(self.T_parent_camera @ se3_exp(displacement))

    @property
    def is_exact(self) -> bool:
        """Return whether the pose is given without an error."""
        return self.sigma == (0.0, 0.0)

    @property
    def is_full(self) -> bool:
        """Return whether enough frames are measured: if the pose is unknown, they do not agree."""
        return len(self.measured) >= CONSTANTS.agreeing

    def add(self, found: MeasuredPose | str) -> bool:
        """Add the pose (4, 4) of a frame on the parent, or the reason why it has none; return whether it is known."""
        self.tried += 1
        if isinstance(found, str):
            self.reason = found
            return False
        self.measured = [*self.measured, found][-CONSTANTS.agreeing :]
        if len(self.measured) < CONSTANTS.agreeing:
            self.reason = f"{len(self.measured)} of {CONSTANTS.agreeing} frames are aligned to the map"
            return False
        T, covariance = fused(self.measured)
        if not all(is_within(pose_distance(T, m.T_world_camera), CONSTANTS.agreement) for m in self.measured):
            self.reason = "the poses of its frames contradict each other"
            return False
        deviation = np.abs(se3_log(inverse(self.T_parent_camera) @ T)) / np.repeat(self.sigma, 3)
        if deviation.max() > CONSTANTS.gate:
            self.reason = f"the map implies a pose {deviation.max():.0f} σ from the given one"
            return False
        self.T_parent_camera, self.covariance = T, covariance
        self.known, self.measured = True, []
        return True

    def forget(self) -> None:
        """Make the pose the start of a new estimate: the camera has moved."""
        self.known, self.measured = False, []

    def move(self, T_new_old: Array) -> None:
        """Move a known pose with a correction (4, 4) of the map; a given one refers to the origin and stays."""
        self.measured = []
        if self.known:
            self.T_parent_camera = T_new_old @ self.T_parent_camera


def fused(poses: Sequence[MeasuredPose]) -> tuple[Array, Array]:
    """Return the information-weighted mean (4, 4) of poses, and the covariance (6, 6) of one of them.

    All frames share the errors of the map, so their mean is not taken as more accurate than one of them::

        ξ ← (Σ Λ_i)⁻¹ Σ Λ_i log(T⁻¹ T_i),  T ← T exp(ξ)
    """
    T = poses[0].T_world_camera
    information = [np.linalg.inv(pose.covariance) for pose in poses]
    for _ in range(3):
        weighted = [L @ se3_log(inverse(T) @ p.T_world_camera) for L, p in zip(information, poses, strict=True)]
        T = T @ se3_exp(np.linalg.solve(np.sum(information, axis=0), np.sum(weighted, axis=0)))
    return np.asarray(T), len(poses) * np.linalg.inv(np.sum(information, axis=0))

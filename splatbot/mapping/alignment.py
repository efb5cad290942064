"""Alignment of two maps: keyframes of one are located among those of the other, and several must agree."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.config import Config
from splatbot.errors import InputError
from splatbot.frame import Frame
from splatbot.geometry import adjoint, inverse, se3_log
from splatbot.mapping.extrinsics import MeasuredPose, fused, locate_in_map
from splatbot.mapping.keyframes import Keyframe
from splatbot.spacing import evenly_spaced
from splatbot.tracking.features import match_pose
from splatbot.tracking.nearby_keyframes import is_within, pose_distance
from splatbot.tracking.place_recognition import likeliest
from splatbot.tracking.prepare import PreparedFrame, prepare

Array = NDArray[np.float64]
Report = Callable[[float], None]


@dataclass(frozen=True)
class MapAlignmentConstants:
    """Constants of the alignment of two maps.

    Args:
        keyframes: largest number of keyframes that are located, evenly spaced; each takes a second or less.
        candidates: keyframes with the most votes that features are matched with.
        agreement: [m], [rad] distance of a located keyframe from its pose by the common transform. It includes the
            drift of both maps.
        least_agreeing: number of keyframes that must agree.
        least_share: share of the located keyframes that must agree. Repeated places confirm a wrong transform
            with a part of them.
        drift: [m], [rad] standard deviation of the drift of both maps at a keyframe, which adds to that of its
            alignment. Drift is larger: without it, a few keyframes with much texture would determine the transform.
    """

    keyframes: int = 40
    candidates: int = 4
    agreement: tuple[float, float] = (0.06, 0.06)
    least_agreeing: int = 3
    least_share: float = 0.6
    drift: tuple[float, float] = (5e-3, 3e-3)


CONSTANTS = MapAlignmentConstants()

_HINT = "both must show the same places from similar directions; map a log that views a part of A as well"


@dataclass(frozen=True, eq=False)
class MapAlignment:
    """Pose of map B in map A.

    Args:
        T_a_b: (4, 4) from the world of B to that of A.
        covariance: (6, 6) of its twist (t [m], ω [rad]) in the world of B.
        located: pose in A of each keyframe of B that agrees, by its number.
        tried: number of keyframes of B that were searched for in A.
        found: number of them that were located, with those that do not agree.
    """

    T_a_b: Array
    covariance: Array
    located: Mapping[int, MeasuredPose]
    tried: int
    found: int

    @property
    def sigmas(self) -> tuple[float, float]:
        """Largest standard deviation of the translation [m] and of the rotation [rad]."""
        parts = (self.covariance[:3, :3], self.covariance[3:, 3:])
        moved, turned = (float(np.sqrt(np.linalg.eigvalsh(part)[-1])) for part in parts)
        return moved, turned


def align_maps(
    keyframes_a: Sequence[Keyframe],
    keyframes_b: Sequence[Keyframe],
    config: Config,
    report: Report = lambda _share: None,
) -> MapAlignment:
    """Locate map B in map A.

    1. Each keyframe of B is matched by features with the keyframes of A that look most alike, and aligned to A.
    2. The transform with which most of these poses agree places all keyframes of B, and each is aligned from there.
    3. T_a_b is the information-weighted mean of the poses that agree. Its covariance grows with their scatter (the
       Birge ratio, see :func:`splatbot.mapping.bundle.variance_ratio`).

    Args:
        keyframes_a, keyframes_b: of the two maps, each with poses in its own world.
        config: configuration of B.
        report: called with the finished share of the work.

    Raises:
        InputError: B has too few keyframes, the maps show no common place, or the located keyframes contradict each
            other.
    """
    chosen = evenly_spaced([k for k in keyframes_b if len(k.features)], CONSTANTS.keyframes)
    if not chosen or not any(len(k.features) for k in keyframes_a):
        raise InputError("a map has no keyframes with features.", field="keyframes", hint="map its log again")
    if len(chosen) < CONSTANTS.least_agreeing:
        few = f"B has {len(chosen)} keyframes, {CONSTANTS.least_agreeing} are needed."
        raise InputError(few, field="keyframes", hint="record longer")
    frames = [prepare(_frame_of(keyframe), config.tracking) for keyframe in chosen]
    first: dict[int, MeasuredPose] = {}
    for done, (keyframe, prepared) in enumerate(zip(chosen, frames, strict=True)):
        start = _by_features(keyframe, keyframes_a)
        if start is not None:
            _locate(first, keyframe, prepared, keyframes_a, start, config)
        report(0.5 * (done + 1) / len(chosen))
    common = _common(first, chosen)
    second: dict[int, MeasuredPose] = {}
    for done, (keyframe, prepared) in enumerate(zip(chosen, frames, strict=True)):
        start = common @ keyframe.T_world_camera
        _locate(second, keyframe, prepared, keyframes_a, start, config)
        report(0.5 + 0.5 * (done + 1) / len(chosen))
    _common(second, chosen)
    poses = {k.number: k.T_world_camera for k in chosen}
    agreeing = {n: found for n, found in second.items() if _agrees(common, found, poses[n])}
    T, covariance = fused([_world_of(found, poses[n]) for n, found in agreeing.items()])
    deviation = covariance / len(agreeing) * _birge(T, agreeing, poses)
    return MapAlignment(T, deviation, agreeing, len(chosen), len(second))


def _frame_of(keyframe: Keyframe) -> Frame:
    """Return the images of a keyframe, which are rectified, as a frame."""
    mask = None if keyframe.static_mask is None else keyframe.static_mask.numpy()
    return Frame(0.0, keyframe.rgb.numpy(), keyframe.depth.numpy(), keyframe.camera, keyframe.number, mask=mask)


def _by_features(keyframe: Keyframe, others: Sequence[Keyframe]) -> Array | None:
    """Return the pose (4, 4) in the world of other keyframes by the features of those that look most alike."""
    alike = [others[k] for k in likeliest(keyframe.features, others, CONSTANTS.candidates)]
    known = [(other.features, other.T_world_camera) for other in alike]
    matched = match_pose(keyframe.features, known, _camera_of_features(keyframe))
    return None if matched is None else matched.T_world_camera


def _camera_of_features(keyframe: Keyframe) -> Camera:
    """Return the camera of the image in which features were detected: the images of a keyframe are halves of it.

    Its size follows from the pixels of the features and the pixels of their points in the keyframe.
    """
    features, camera = keyframe.features, keyframe.camera
    known = np.isfinite(features.points[:, 2]) & (features.points[:, 2] > 0)
    if not known.any():
        return camera
    ratio = (features.pixels[known] + 0.5) / (camera.project(features.points[known]) + 0.5)
    factor = 2 ** round(float(np.log2(np.median(ratio))))
    return camera.resized(factor * camera.width, factor * camera.height)


def _locate(
    found: dict[int, MeasuredPose],
    keyframe: Keyframe,
    prepared: PreparedFrame,
    others: Sequence[Keyframe],
    start: Array,
    config: Config,
) -> None:
    """Add the pose of a keyframe among others, if its images and theirs determine it."""
    measured = locate_in_map(prepared, others, start, config)
    if not isinstance(measured, str):
        drift = np.diag(np.repeat(np.square(CONSTANTS.drift), 3))
        found[keyframe.number] = replace(measured, covariance=measured.covariance + drift)


def _common(located: Mapping[int, MeasuredPose], keyframes: Sequence[Keyframe]) -> Array:
    """Return the transform (4, 4) from B to A of the located keyframe that most of the others agree with.

    Raises:
        InputError: too few keyframes are located, or they do not agree.
    """
    poses = {k.number: k.T_world_camera for k in keyframes}
    transforms = [found.T_world_camera @ inverse(poses[n]) for n, found in located.items()]
    counts = [sum(_agrees(T, found, poses[n]) for n, found in located.items()) for T in transforms]
    most = max(counts, default=0)
    if len(located) < CONSTANTS.least_agreeing:
        counted = f"{len(located)} of {len(keyframes)} keyframes of B are found in A"
        few = f"only {counted}, {CONSTANTS.least_agreeing} are needed."
        raise InputError(few, field="overlap", hint=_HINT)
    if most < max(CONSTANTS.least_agreeing, CONSTANTS.least_share * len(located)):
        apart = f"only {most} of {len(located)} keyframes of B that are found in A agree on its pose."
        raise InputError(apart, field="T_A_B", hint="one of the maps is wrong, or shows several places that look alike")
    return np.asarray(transforms[int(np.argmax(counts))])


def _agrees(T_a_b: Array, found: MeasuredPose, T_b_camera: Array) -> bool:
    return is_within(pose_distance(T_a_b @ T_b_camera, found.T_world_camera), CONSTANTS.agreement)


def _world_of(found: MeasuredPose, T_b_camera: Array) -> MeasuredPose:
    """Return T_a_b by one located keyframe, and the covariance of its twist in the world of B."""
    A = adjoint(T_b_camera)
    return MeasuredPose(found.T_world_camera @ inverse(T_b_camera), A @ found.covariance @ A.T)


def _birge(T_a_b: Array, agreeing: Mapping[int, MeasuredPose], poses: Mapping[int, Array]) -> float:
    """Compute the mean of rᵀ Σ⁻¹ r / 6 over the located keyframes, at least 1."""
    ratios = []
    for n, found in agreeing.items():
        residual = se3_log(inverse(found.T_world_camera) @ T_a_b @ poses[n])
        ratios.append(float(residual @ np.linalg.solve(found.covariance, residual)) / 6)
    return max(1.0, float(np.mean(ratios)))

"""Keyframes: frames that the map is built from and that later frames are tracked against."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import cv2
import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatbot import _native
from splatbot.camera import Camera
from splatbot.config import Config, MappingConfig, TrackingConfig
from splatbot.frame import Frame
from splatbot.geometry import inverse
from splatbot.tracking.features import Features
from splatbot.tracking.nearby_keyframes import is_within, pose_distance
from splatbot.tracking.prepare import Level, halve, usable_depth
from splatbot.tracking.reference import Reference


@dataclass(frozen=True)
class SmoothingConstants:
    """Constants of depth smoothing.

    Args:
        row_step: every this many image rows serve the estimate of the noise.
        median_of_absolute: median of the absolute value of a standard normal variable.
        gate_sigma: [σ of depth] limit of a pixel's deviation from the mean of two neighbors. On a plane that deviation
            has the standard deviation √1.5 σ, so the gate is three of its deviations.
        full_mask_share: a resized mask is true where at least this share of the covered pixels is.
    """

    row_step: int = 4
    median_of_absolute: float = 0.6745
    gate_sigma: float = 3.7
    full_mask_share: float = 0.999


CONSTANTS = SmoothingConstants()


class HasPose(Protocol):
    """An object with a pose."""

    @property
    def T_world_camera(self) -> NDArray[np.float64]: ...


@dataclass
class Keyframe:
    """A frame with the images that the map keeps.

    Args:
        number: consecutive number of all keyframes, including removed ones.
        camera: of these images.
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32 [m], 0 missing.
        T_world_camera: (4, 4).
        features: keypoints that later frames are matched with.
        reference: pixels that later frames are aligned to; their depth is the map's once the keyframe is in the map.
        static_mask: (H, W) bool, pixels that are neither masked nor show a dynamic object; elsewhere, depth is 0. If
            None, all pixels are static.
        is_poor: whether it is blurred or degraded, so that a better view of the place replaces it.
        camera_name: name of its camera; empty for the first one.
    """

    number: int
    camera: Camera
    rgb: Tensor
    depth: Tensor
    T_world_camera: NDArray[np.float64]
    features: Features
    reference: Reference
    static_mask: Tensor | None = None
    is_poor: bool = False
    camera_name: str = ""

    @property
    def viewmat(self) -> Tensor:
        """T_camera_world (1, 4, 4) float64 for the rasterizer."""
        return torch.from_numpy(inverse(self.T_world_camera))[None]

    @property
    def K(self) -> Tensor:
        """Intrinsic matrix (1, 3, 3) float64, for pixel centers at +0.5."""
        return torch.from_numpy(self.camera.K_corner)[None]


NUMBERS = 2**20
"""Keyframes of the k-th further camera are numbered from k times this one; those of the first camera from 0."""


def first_number(camera_name: str, config: Config) -> int:
    """Return the number of the first keyframe of a camera."""
    return NUMBERS * (1 + [*config.cameras].index(camera_name)) if camera_name else 0


def mapping_images(
    frame: Frame, config: MappingConfig, tracking: TrackingConfig
) -> tuple[Camera, NDArray[np.uint8], NDArray[np.float32]]:
    """Return camera, color and valid, unmasked, smoothed depth, halved until at most ``config.max_width`` wide."""
    rgb = frame.rgb
    level = Level(np.zeros(frame.depth.shape, np.float32), usable_depth(frame, tracking), frame.camera)
    while level.camera.width > config.max_width:
        level = halve(level)
        width, height = level.camera.width, level.camera.height
        even = rgb[: 2 * height, : 2 * width]  # the crop of `halve`: with an odd size, color would shift against depth
        rgb = np.asarray(cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return level.camera, rgb, smooth_depth(level.depth, config, tracking)


def smooth_depth(depth: NDArray[np.float32], config: MappingConfig, tracking: TrackingConfig) -> NDArray[np.float32]:
    """Average each pixel of a depth image (H, W) [m] over the 3x3 neighbors on its surface; 0 stays missing.

    A Gaussian represents about 3x3 pixels, and all of them measured its position. If Gaussians scattered by the noise
    of single pixels, the nearer ones would occlude the others. The rendered surface and the poses aligned to it would
    then be biased towards the camera. A curvature beyond the noise of the image is shape and remains.
    """
    gate = CONSTANTS.gate_sigma * noise_share(depth, tracking)
    floor, quad = gate * tracking.sensor.sigma_depth_floor, gate * tracking.sensor.sigma_depth_quad
    return np.asarray(_native.smooth_depth(np.ascontiguousarray(depth), config.surface_depth_tolerance, floor, quad))


def noise_share(depth: NDArray[np.float32], tracking: TrackingConfig) -> float:
    """Estimate the noise of depth (H, W) [m] relative to the sensor model, at most 1; 0 for depth without noise.

    On a plane, the deviation of a pixel from the mean of its neighbors in the row has the standard deviation √1.5 σ.
    Its median absolute value gives σ.
    """
    z = depth[:: CONSTANTS.row_step].astype(np.float64)
    left, z, right = z[:, :-2], z[:, 1:-1], z[:, 2:]
    known = (left > 0) & (z > 0) & (right > 0)
    if not known.any():
        return 0.0
    bend = np.abs((left + right) / 2 - z)[known] / (
        tracking.sensor.sigma_depth_floor + tracking.sensor.sigma_depth_quad * z[known] ** 2
    )
    return min(1.0, float(np.median(bend)) / (CONSTANTS.median_of_absolute * np.sqrt(1.5)))


def is_keyframe(T_world_camera: NDArray[np.float64], keyframes: Sequence[HasPose], config: MappingConfig) -> bool:
    """Return whether a view is new: its translation or rotation from every keyframe exceeds the configured limit."""
    return not any(is_same_view(k.T_world_camera, T_world_camera, config) for k in reversed(keyframes))


def is_same_view(T_world_a: NDArray[np.float64], T_world_b: NDArray[np.float64], config: MappingConfig) -> bool:
    """Return whether two poses (4, 4) differ by less than the distance between keyframes."""
    return is_within(pose_distance(T_world_a, T_world_b), (config.keyframe_translation, config.keyframe_rotation))


def resized(mask: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """Resize a mask to (rows, columns); a pixel is true if all pixels that it covers are."""
    if mask.shape == shape:
        return mask
    share = cv2.resize(mask.astype(np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
    return np.asarray(share > CONSTANTS.full_mask_share)

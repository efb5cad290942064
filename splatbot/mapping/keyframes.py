"""Keyframes: the frames that the map is made of and that later frames are tracked against."""

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
from splatbot.config import MappingConfig, TrackingConfig
from splatbot.frame import Frame
from splatbot.geometry import inverse
from splatbot.tracking.features import Features
from splatbot.tracking.prepare import Level, halve, usable_depth
from splatbot.tracking.reference import Reference
from splatbot.tracking.tracker import pose_distance

_ROWS = 4  # of which one tells the noise
_MAD = 0.6745  # median of the absolute of a normal variable
_GATE = 3.7  # σ of depth: three of how far, on a plane, a pixel lies from half-way between two others, which is √1.5 σ


class HasPose(Protocol):
    """What has a pose."""

    @property
    def T_world_camera(self) -> NDArray[np.float64]: ...


@dataclass
class Keyframe:
    """One observation as the map keeps it.

    Args:
        number: counts all keyframes there have been.
        camera: of the images kept here.
        rgb: (H, W, 3) uint8.
        depth: (H, W) float32 [m], 0 missing.
        T_world_camera: (4, 4).
        features: for matching later frames.
        static_mask: (H, W) bool, pixels that show nothing that moves or is masked, depth being 0 elsewhere; None: all.
        reference: for aligning later frames; its depth is the model's once the keyframe has been fused.
    """

    number: int
    camera: Camera
    rgb: Tensor
    depth: Tensor
    T_world_camera: NDArray[np.float64]
    features: Features
    reference: Reference
    static_mask: Tensor | None = None

    @property
    def viewmat(self) -> Tensor:
        """T_camera_world (1, 4, 4) float64, as the rasterizer takes it."""
        return torch.from_numpy(inverse(self.T_world_camera))[None]

    @property
    def K(self) -> Tensor:
        """(1, 3, 3) float64 for pixel centres at +0.5."""
        return torch.from_numpy(self.camera.K_corner)[None]


def mapping_images(
    frame: Frame, config: MappingConfig, tracking: TrackingConfig
) -> tuple[Camera, NDArray[np.uint8], NDArray[np.float32]]:
    """Camera, colour and valid, unmasked, smoothed depth of a frame, halved until at most ``config.max_width`` wide."""
    rgb = frame.rgb
    level = Level(np.zeros(frame.depth.shape, np.float32), usable_depth(frame, tracking), frame.camera)
    while level.camera.width > config.max_width:
        level = halve(level)
        width, height = level.camera.width, level.camera.height
        even = rgb[: 2 * height, : 2 * width]  # as `halve` crops, or an odd size would shift colour against depth
        rgb = np.asarray(cv2.resize(even, (width, height), interpolation=cv2.INTER_AREA), dtype=np.uint8)
    return level.camera, rgb, smooth_depth(level.depth, config, tracking)


def smooth_depth(depth: NDArray[np.float32], config: MappingConfig, tracking: TrackingConfig) -> NDArray[np.float32]:
    """Depth (H, W) [m], each pixel the mean of those of its 3x3 that are of its surface; 0 stays missing.

    A Gaussian stands for some 3x3 pixels, and all of them measured where it is. Of Gaussians that scatter by a single
    pixel's noise the nearer ones cover the others, so the blend would lie before the surface, most where it was seen
    once, and what is aligned to it would be off. What bends by more than the image's own noise is shape, and kept.
    """
    gate = _GATE * noise_share(depth, tracking)
    floor, quad = gate * tracking.sensor.sigma_depth_floor, gate * tracking.sensor.sigma_depth_quad
    return np.asarray(_native.smooth_depth(np.ascontiguousarray(depth), config.surface_depth_tolerance, floor, quad))


def noise_share(depth: NDArray[np.float32], tracking: TrackingConfig) -> float:
    """The noise of depth (H, W) [m] over what tracking allows for, at most 1; 0 of depth that shows none.

    By the median of how far pixels lie from half-way between their neighbours in the row, which is σ √1.5 of a plane.
    """
    z = depth[::_ROWS].astype(np.float64)
    left, z, right = z[:, :-2], z[:, 1:-1], z[:, 2:]
    known = (left > 0) & (z > 0) & (right > 0)
    if not known.any():
        return 0.0
    bend = np.abs((left + right) / 2 - z)[known] / (
        tracking.sensor.sigma_depth_floor + tracking.sensor.sigma_depth_quad * z[known] ** 2
    )
    return min(1.0, float(np.median(bend)) / (_MAD * np.sqrt(1.5)))


def is_keyframe(T_world_camera: NDArray[np.float64], keyframes: Sequence[HasPose], config: MappingConfig) -> bool:
    """Whether a view is new: farther or turned further from every keyframe than the configuration says."""
    for keyframe in reversed(keyframes):
        moved, turned = pose_distance(keyframe.T_world_camera, T_world_camera)
        if moved < config.keyframe_translation and turned < config.keyframe_rotation:
            return False
    return True


def resized(mask: NDArray[np.bool_], shape: tuple[int, ...]) -> NDArray[np.bool_]:
    """The mask at another size (rows, columns): true where all that a pixel covers is."""
    if mask.shape == shape:
        return mask
    share = cv2.resize(mask.astype(np.float32), (shape[1], shape[0]), interpolation=cv2.INTER_AREA)
    return np.asarray(share > 0.999)

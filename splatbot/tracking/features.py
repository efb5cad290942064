"""Sparse features: ORB keypoints with depth, and the pose from matching them with keyframes (PnP in RANSAC)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera
from splatbot.geometry import inverse, transform_points
from splatbot.tracking.prepare import Image

# Minimal trust in a pose from features: fewer inliers than this, or a smaller share, happens by chance.
MIN_INLIERS = 20
_MAX_REPROJECTION = 3.0  # [px]
_MATCH_RATIO = 0.8  # Lowe's ratio test


@dataclass(frozen=True)
class Features:
    """Keypoints of one image.

    Args:
        pixels: (N, 2).
        descriptors: (N, 32) uint8.
        points: (N, 3) [m] in the camera frame, NaN where there is no depth.
    """

    pixels: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    points: NDArray[np.float64]

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True)
class FeaturePose:
    """T_world_camera (4, 4) from features, and the matches that agree with it: points (M, 3) [m] and pixels (M, 2)."""

    T_world_camera: NDArray[np.float64]
    points: NDArray[np.float64]
    pixels: NDArray[np.float64]
    matches: int


def detect(rgb: NDArray[np.uint8], depth: Image, camera: Camera, n_features: int) -> Features:
    """ORB keypoints of an image, with 3-D points where a depth of the same surface lies within two pixels."""
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    keypoints, descriptors = cv2.ORB.create(nfeatures=n_features, fastThreshold=10).detectAndCompute(gray, None)
    if descriptors is None:
        return Features(np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8), np.zeros((0, 3)))
    pixels = np.array([k.pt for k in keypoints], dtype=np.float32)
    z = _depth_at(depth, pixels)
    rays = np.stack(
        [(pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy, np.ones(len(z))], 1
    )
    return Features(pixels, np.asarray(descriptors, dtype=np.uint8), rays * z[:, None])


def match_pose(
    current: Features,
    keyframes: Sequence[tuple[Features, NDArray[np.float64]]],
    camera: Camera,
) -> FeaturePose | None:
    """Pose of ``current`` from 2D-3D matches with keyframes given as (features, T_world_camera).

    P3P in RANSAC (Gao et al. 2003), then Levenberg-Marquardt on the inliers; OpenCV's RANSAC is seeded alike on every
    call, so the result is repeatable. None when too few matches agree.
    """
    matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
    pixels, points = [], []
    for features, T_world_keyframe in keyframes:
        anchored = np.flatnonzero(np.isfinite(features.points[:, 2]))
        if len(anchored) < 8 or len(current) < 8:
            continue
        pairs = [
            (first.queryIdx, anchored[first.trainIdx])
            for first, second in matcher.knnMatch(current.descriptors, features.descriptors[anchored], k=2)
            if first.distance < _MATCH_RATIO * second.distance
        ]
        if pairs:
            query, train = np.array(pairs).T
            pixels.append(current.pixels[query])
            points.append(transform_points(T_world_keyframe, features.points[train]))
    if not pixels:
        return None
    image, world = np.concatenate(pixels).astype(np.float64), np.concatenate(points)
    if len(image) < MIN_INLIERS:
        return None
    found, r, t, inliers = cv2.solvePnPRansac(
        world,
        image,
        camera.K,
        None,
        iterationsCount=500,
        reprojectionError=_MAX_REPROJECTION,
        confidence=0.9999,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not found or inliers is None or len(inliers) < MIN_INLIERS:
        return None
    agree = inliers[:, 0]
    r, t = cv2.solvePnPRefineLM(world[agree], image[agree], camera.K, None, r, t)
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3] = cv2.Rodrigues(r)[0]
    T_camera_world[:3, 3] = t[:, 0]
    if not np.isfinite(T_camera_world).all():
        return None
    return FeaturePose(inverse(T_camera_world), world[agree], image[agree], len(image))


def _depth_at(depth: Image, pixels: NDArray[np.float32]) -> NDArray[np.float64]:
    """Median depth (N,) of the 5x5 pixels around each pixel; NaN where none is valid or they span two surfaces."""
    padded = np.pad(depth, 2)
    u = np.clip(np.rint(pixels[:, 0]).astype(int), 0, depth.shape[1] - 1)
    v = np.clip(np.rint(pixels[:, 1]).astype(int), 0, depth.shape[0] - 1)
    du, dv = np.meshgrid(np.arange(5), np.arange(5))
    window = padded[v[:, None] + dv.ravel(), u[:, None] + du.ravel()].astype(np.float64)
    window[window == 0] = np.nan
    z = np.full(len(pixels), np.nan)
    seen = np.isfinite(window).any(1)
    z[seen] = np.nanmedian(window[seen], axis=1)
    spread = np.zeros(len(pixels))
    spread[seen] = np.nanmax(window[seen], axis=1) - np.nanmin(window[seen], axis=1)
    z[spread > 0.05 * np.nan_to_num(z)] = np.nan
    return z

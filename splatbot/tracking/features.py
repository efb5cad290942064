"""Sparse features: ORB keypoints with depth, and the pose from matching them with keyframes (PnP in RANSAC)."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot import _native
from splatbot.camera import Camera
from splatbot.geometry import inverse, transform_points
from splatbot.tracking.prepare import Image

Array = NDArray[np.float64]
Index = NDArray[np.intp]

# Minimal trust in a pose from features: fewer inliers than this, or a smaller share, happens by chance.
MIN_INLIERS = 20
_MAX_REPROJECTION = 3.0  # [px]
_SCALE_FACTOR = 1.2  # from one level of ORB's pyramid to the next
_MATCH_RATIO = 0.8  # Lowe's ratio test
_MIN_SPREAD = 0.05  # standard deviation of matched pixels across their narrowest direction [image width]
_TILES = 8  # across the image, that keypoints are spread over
_CROWD = 2.0  # times its share of them that a tile has at most
_TO_CHOOSE_FROM = 2  # times as many keypoints as are kept
_PATCH = 31  # [px] that an ORB descriptor looks at on the finest level
_MATCH_BITS = 64  # descriptors that differ in more of their 256 bits are strangers


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints of one image.

    Args:
        pixels: (N, 2).
        descriptors: (N, 32) uint8.
        points: (N, 3) [m] in the camera frame, NaN where there is no depth.
        scales: (N,) size [px] of a pixel of the pyramid's level that each was found on: it is placed that much worse.
    """

    pixels: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    points: Array
    scales: NDArray[np.float32]

    @classmethod
    def none(cls) -> Features:
        """Those of an image without any."""
        return cls(np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8), np.zeros((0, 3)), np.zeros(0, np.float32))

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True)
class FeaturePose:
    """T_world_camera (4, 4) from features, and the matches that agree with it.

    Args:
        points: (M, 3) [m], world frame.
        pixels: (M, 2).
        sigmas: (M,) of the pixels [px].
        matches: how many there were.
    """

    T_world_camera: Array
    points: Array
    pixels: Array
    sigmas: Array
    matches: int


def detect(
    rgb: NDArray[np.uint8], depth: Image, camera: Camera, n_features: int, mask: NDArray[np.bool_] | None = None
) -> Features:
    """ORB keypoints of an image, with 3-D points where a depth of the same surface lies within two pixels.

    They are spread over the image, see :func:`spread`. None is nearer to a pixel that ``mask`` (H, W) leaves out than
    its descriptor reaches.
    """
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    usable = None
    if mask is not None:
        gray[~mask] = 128  # coarse levels of ORB's pyramid reach further than the margin: let them see nothing there
        usable = cv2.erode(mask.astype(np.uint8), np.ones((_PATCH, _PATCH), np.uint8))
    orb = cv2.ORB.create(nfeatures=_TO_CHOOSE_FROM * n_features, scaleFactor=_SCALE_FACTOR, fastThreshold=10)
    found = orb.detect(gray, usable)
    if not found:
        return Features.none()
    pixels, _ = _pixels(found)
    known = _native.depth_around(depth, pixels) > 0
    chosen = spread(pixels, np.array([k.response for k in found]), known, camera.width, n_features)
    keypoints, descriptors = orb.compute(gray, [found[k] for k in chosen])
    if descriptors is None:
        return Features.none()
    pixels, scales = _pixels(keypoints)
    z = np.asarray(_native.depth_around(depth, pixels))
    rays = np.stack(
        [(pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy, np.ones(len(z))], 1
    )
    return Features(pixels, np.asarray(descriptors, dtype=np.uint8), rays * z[:, None], scales)


def _pixels(keypoints: Sequence[cv2.KeyPoint]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Where keypoints are in the image (N, 2), and the scales (N,) of their levels."""
    scales = np.float32(_SCALE_FACTOR) ** np.array([k.octave for k in keypoints], dtype=np.float32)
    # OpenCV scales a level's coordinates about the corner pixel's centre, the level itself is scaled about its corner.
    corners = np.array(cv2.KeyPoint.convert(keypoints), dtype=np.float32).reshape(-1, 2)
    return corners + 0.5 * (scales[:, None] - 1), scales


def spread(
    pixels: NDArray[np.float32],
    strengths: NDArray[np.float64],
    known: NDArray[np.bool_],
    width: int,
    count: int,
) -> Index:
    """Indices of at most ``count`` keypoints at pixels (N, 2): the strongest that are not more than a tile's part.

    A tile has at most ``_CROWD`` times its share while others have some left. Those ``known`` (N,), whose depth is,
    come first: only they anchor a pose.

    The strongest of all are often together on one textured thing. There a turn and a shift of the camera look alike,
    and so does a shutter that rolls while it moves, which stretches the image: small errors of all of them become
    centimetres of the pose. Every part of the image together tells these apart (Mur-Artal et al. 2015, sec. V-A).
    """
    across, down = (pixels * (_TILES / width)).astype(np.intp).T
    tile = down * (_TILES + 1) + across
    crowd = max(1, int(_CROWD * count / max(len(np.unique(tile)), 1)))
    order = np.lexsort((-strengths, ~known, tile))
    begins = np.r_[0, np.flatnonzero(np.diff(tile[order])) + 1]
    rank = np.empty(len(order), np.intp)
    rank[order] = np.arange(len(order)) - np.repeat(begins, np.diff(np.r_[begins, len(order)]))
    return np.lexsort((-strengths, np.maximum(rank, crowd - 1), ~known))[:count]


@dataclass(frozen=True)
class Expectation:
    """Where a frame should be, T_world_camera (4, 4), and how far its features may lie from there: ``radius`` [px]."""

    T_world_camera: Array
    radius: float


def match_pose(
    current: Features,
    keyframes: Sequence[tuple[Features, Array]],
    camera: Camera,
    expected: Expectation | None = None,
) -> FeaturePose | None:
    """Pose of ``current`` from 2D-3D matches with keyframes given as (features, T_world_camera).

    A keyframe's points are looked for near to where they are expected, or everywhere. Then P3P in RANSAC (Gao et al.
    2003) and Levenberg-Marquardt on the inliers; OpenCV's RANSAC is seeded alike on every call, so the result is
    repeatable. None when too few matches agree. Near to an expectation, also None when those that do pile up at the
    edge of the search, or in one corner of the image: it was wrong, and what was found is a choice that agrees with it.
    """
    pixels, points, sigmas = [], [], []
    for features, T_world_keyframe in keyframes:
        anchored = np.flatnonzero(np.isfinite(features.points[:, 2]))
        world = transform_points(T_world_keyframe, features.points[anchored])
        if expected is None:
            places, radius = np.zeros((len(anchored), 2), np.float32), np.inf
        else:
            seen = transform_points(inverse(expected.T_world_camera), world)
            ahead = seen[:, 2] > 1e-3
            anchored, world = anchored[ahead], world[ahead]
            places, radius = camera.project(seen[ahead]).astype(np.float32), expected.radius
        query, train = _match(current, features.descriptors[anchored], places, radius)
        pixels.append(current.pixels[query])
        points.append(world[train])
        sigmas.append(np.maximum(current.scales[query], features.scales[anchored[train]]))
    if not pixels:
        return None
    found = _pose_from_matches(
        np.concatenate(pixels).astype(np.float64),
        np.concatenate(points),
        np.concatenate(sigmas).astype(np.float64),
        camera,
    )
    if found is None or expected is None:
        return found
    return found if _is_believable(found, camera, expected) else None


def _is_believable(found: FeaturePose, camera: Camera, expected: Expectation) -> bool:
    """Whether a pose from a search near to an expectation is more than a choice that agrees with it."""
    shift = camera.project(transform_points(inverse(expected.T_world_camera), found.points)) - found.pixels
    inside = np.percentile(np.linalg.norm(shift, axis=1), 80) < 0.5 * expected.radius
    narrowest = np.sqrt(max(np.linalg.eigvalsh(np.cov(found.pixels.T))[0], 0.0))
    return bool(inside and narrowest > _MIN_SPREAD * camera.width)


def _match(
    current: Features, descriptors: NDArray[np.uint8], expected: NDArray[np.float32], radius: float
) -> tuple[Index, Index]:
    """Indices of current keypoints, and of those expected at pixels (M, 2) with descriptors (M, 32) that they match."""
    found = _native.match_near(
        expected, descriptors, current.pixels, current.descriptors, radius, _MATCH_BITS, _MATCH_RATIO
    )
    train = np.flatnonzero(found >= 0)
    return found[train].astype(np.intp), train


def _pose_from_matches(image: Array, world: Array, sigmas: Array, camera: Camera) -> FeaturePose | None:
    """PnP of pixels (M, 2), σ (M,), and points (M, 3)."""
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
    return FeaturePose(inverse(T_camera_world), world[agree], image[agree], sigmas[agree], len(image))

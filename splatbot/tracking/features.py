"""ORB keypoints with depth, and the pose from their matches with keyframes by PnP in RANSAC."""

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


@dataclass(frozen=True)
class FeatureConstants:
    """Empirical constants of detection, matching and PnP."""

    min_inliers: int = 20
    """Number of inliers [1] below which a pose from features may be a coincidence."""
    max_reprojection: float = 3.0
    """Largest reprojection error [px] of an inlier. A larger one accepts wrong matches."""
    scale_factor: float = 1.2
    """Ratio [1] between levels of ORB's pyramid."""
    fast_threshold: int = 10
    """Grey difference [0..255] of a FAST corner. A smaller one detects noise in dark images."""
    max_ratio: float = 0.8
    """Largest ratio [1] of the best to the second best distance (Lowe 2004). A larger one adds ambiguous matches."""
    min_spread: float = 0.05
    """Smallest standard deviation [image width] of matched pixels along their narrowest direction. Matches in one
    corner of the image hardly constrain the pose."""
    tiles: int = 8
    """Number of tiles [1] across the image for the distribution of keypoints."""
    crowding: float = 2.0
    """Largest share of keypoints in a tile, relative to its equal share [1]. A larger one concentrates them."""
    oversampling: int = 2
    """Number of detected keypoints per selected one [1]. More of them spread better and take longer."""
    patch: int = 31
    """Side [px] of the patch of an ORB descriptor on the finest level."""
    max_hamming: int = 64
    """Largest Hamming distance [bit of 256] of two descriptors that match."""
    ransac_iterations: int = 500
    """Largest number of RANSAC iterations [1]."""
    ransac_confidence: float = 0.9999
    """Probability [1] that RANSAC finds a sample without outliers."""


CONSTANTS = FeatureConstants()


@dataclass(frozen=True, eq=False)
class Features:
    """Keypoints of one image.

    Args:
        pixels: (N, 2).
        descriptors: (N, 32) uint8.
        points: (N, 3) [m] in the camera frame, NaN without depth.
        scales: (N,) size [px] of a pixel of the pyramid level on which each keypoint was detected. The standard
            deviation of the keypoint is proportional to it.
    """

    pixels: NDArray[np.float32]
    descriptors: NDArray[np.uint8]
    points: Array
    scales: NDArray[np.float32]

    @classmethod
    def none(cls) -> Features:
        """Return an empty set of keypoints."""
        return cls(np.zeros((0, 2), np.float32), np.zeros((0, 32), np.uint8), np.zeros((0, 3)), np.zeros(0, np.float32))

    def __len__(self) -> int:
        return len(self.pixels)


@dataclass(frozen=True)
class FeaturePose:
    """Pose from features with its inlier matches.

    Args:
        T_world_camera: (4, 4).
        points: (M, 3) [m], world frame.
        pixels: (M, 2).
        sigmas: (M,) standard deviations of the pixels [px].
        matches: number of matches with outliers.
    """

    T_world_camera: Array
    points: Array
    pixels: Array
    sigmas: Array
    matches: int


def detect(
    rgb: NDArray[np.uint8], depth: Image, camera: Camera, n_features: int, mask: NDArray[np.bool_] | None = None
) -> Features:
    """Detect ORB keypoints (Rublee et al. 2011), with 3-D points if depth of the same surface lies within two pixels.

    The keypoints are distributed over the image, see :func:`spread`. No descriptor on the finest level reaches a masked
    pixel.

    Args:
        rgb: (H, W, 3) uint8.
        depth: (H, W) [m], 0 if missing.
        camera: camera of the image.
        n_features: largest number of keypoints.
        mask: (H, W), False for pixels to ignore. If None, all pixels are used.
    """
    p = CONSTANTS
    gray = cv2.cvtColor(rgb, cv2.COLOR_RGB2GRAY)
    usable = None
    if mask is not None:
        gray[~mask] = 128  # descriptors on coarse levels reach further than the eroded margin
        usable = cv2.erode(mask.astype(np.uint8), np.ones((p.patch, p.patch), np.uint8))
    orb = cv2.ORB.create(
        nfeatures=p.oversampling * n_features, scaleFactor=p.scale_factor, fastThreshold=p.fast_threshold
    )
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
    """Return the pixels (N, 2) of keypoints and the scales (N,) of their levels."""
    scales = np.float32(CONSTANTS.scale_factor) ** np.array([k.octave for k in keypoints], dtype=np.float32)
    # OpenCV scales the coordinates of a level about the centre of the corner pixel, but the level about its corner.
    corners = np.array(cv2.KeyPoint.convert(keypoints), dtype=np.float32).reshape(-1, 2)
    return corners + 0.5 * (scales[:, None] - 1), scales


def spread(
    pixels: NDArray[np.float32],
    strengths: NDArray[np.float64],
    known: NDArray[np.bool_],
    width: int,
    count: int,
) -> Index:
    """Select keypoints that are distributed over the image (Mur-Artal et al. 2015, sec. V-A), and return their indices.

    The strongest keypoints often lie on one textured object. There, a rotation and a translation of the camera cause
    similar motions of pixels, and so does a rolling shutter. Their small common errors become centimetres of the pose.
    So a tile has at most ``CONSTANTS.crowding`` times its share while other tiles have keypoints left.

    Args:
        pixels: (N, 2).
        strengths: (N,) detector responses.
        known: (N,) True if the keypoint has depth. These come first, because only they constrain a pose in the map.
        width: width of the image [px].
        count: largest number of keypoints.
    """
    p = CONSTANTS
    across, down = (pixels * (p.tiles / width)).astype(np.intp).T
    tile = down * (p.tiles + 1) + across
    crowd = max(1, int(p.crowding * count / max(len(np.unique(tile)), 1)))
    order = np.lexsort((-strengths, ~known, tile))
    begins = np.r_[0, np.flatnonzero(np.diff(tile[order])) + 1]
    rank = np.empty(len(order), np.intp)
    rank[order] = np.arange(len(order)) - np.repeat(begins, np.diff(np.r_[begins, len(order)]))
    return np.lexsort((-strengths, np.maximum(rank, crowd - 1), ~known))[:count]


@dataclass(frozen=True)
class Expectation:
    """Expected pose of a frame.

    Args:
        T_world_camera: (4, 4).
        radius: largest distance [px] of a feature from its pixel at this pose.
    """

    T_world_camera: Array
    radius: float


def match_pose(
    current: Features,
    keyframes: Sequence[tuple[Features, Array]],
    camera: Camera,
    expected: Expectation | None = None,
) -> FeaturePose | None:
    """Estimate the pose of a frame from 2D-3D matches with keyframes.

    P3P in RANSAC (Gao et al. 2003; Fischler and Bolles 1981) selects the inliers. Levenberg-Marquardt then minimises
    their reprojection error Σ ‖π(T X_j) - u_j‖². OpenCV seeds its RANSAC with the same number in each call, so the
    result is repeatable.

    Args:
        current: keypoints of the frame.
        keyframes: features and T_world_camera (4, 4) of each keyframe.
        camera: camera of the frame.
        expected: expected pose, near whose pixels the points are searched for. If None, the whole image is searched.

    Returns:
        The pose, or None if too few matches agree. With an expected pose, the inliers must not accumulate at the border
        of the search or in one corner of the image. Such inliers indicate a wrong expectation.
    """
    image, world, sigmas = _matches(current, keyframes, camera, expected)
    if len(image) < CONSTANTS.min_inliers:
        return None
    found, r, t, inliers = cv2.solvePnPRansac(
        world,
        image,
        camera.K,
        None,
        iterationsCount=CONSTANTS.ransac_iterations,
        reprojectionError=CONSTANTS.max_reprojection,
        confidence=CONSTANTS.ransac_confidence,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not found or inliers is None or len(inliers) < CONSTANTS.min_inliers:
        return None
    agree = inliers[:, 0]
    r, t = cv2.solvePnPRefineLM(world[agree], image[agree], camera.K, None, r, t)
    T_camera_world = np.eye(4)
    T_camera_world[:3, :3] = cv2.Rodrigues(r)[0]
    T_camera_world[:3, 3] = t[:, 0]
    if not np.isfinite(T_camera_world).all():
        return None
    pose = FeaturePose(inverse(T_camera_world), world[agree], image[agree], sigmas[agree], len(image))
    return pose if expected is None or _confirms(pose, camera, expected) else None


def _matches(
    current: Features, keyframes: Sequence[tuple[Features, Array]], camera: Camera, expected: Expectation | None
) -> tuple[Array, Array, Array]:
    """Match features with keyframes, and return pixels (M, 2), world points (M, 3) and σ (M,) [px] of the matches."""
    pixels, points, sigmas = [np.zeros((0, 2), np.float32)], [np.zeros((0, 3))], [np.zeros(0, np.float32)]
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
        query, train = match(current, features.descriptors[anchored], places, radius)
        pixels.append(current.pixels[query])
        points.append(world[train])
        sigmas.append(np.maximum(current.scales[query], features.scales[anchored[train]]))
    return np.concatenate(pixels).astype(np.float64), np.concatenate(points), np.concatenate(sigmas).astype(np.float64)


def _confirms(found: FeaturePose, camera: Camera, expected: Expectation) -> bool:
    """Return True if the inliers lie inside the search radius and are distributed over the image."""
    shift = camera.project(transform_points(inverse(expected.T_world_camera), found.points)) - found.pixels
    inside = np.percentile(np.linalg.norm(shift, axis=1), 80) < 0.5 * expected.radius
    narrowest = np.sqrt(max(np.linalg.eigvalsh(np.cov(found.pixels.T))[0], 0.0))
    return bool(inside and narrowest > CONSTANTS.min_spread * camera.width)


def match(
    current: Features, descriptors: NDArray[np.uint8], expected: NDArray[np.float32], radius: float
) -> tuple[Index, Index]:
    """Match descriptors (M, 32) expected at pixels (M, 2), and return indices of keypoints and of descriptors."""
    p = CONSTANTS
    found = _native.match_near(
        expected, descriptors, current.pixels, current.descriptors, radius, p.max_hamming, p.max_ratio
    )
    train = np.flatnonzero(found >= 0)
    return found[train].astype(np.intp), train

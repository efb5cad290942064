"""Other RGB-D trackers, measured in the same process as splatbot."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
import open3d as o3d
import small_gicp
from numpy.typing import NDArray

from splatbot.frame import Frame
from splatbot.geometry import inverse

Array = NDArray[np.float64]

_MIN_DEPTH, _MAX_DEPTH = 0.2, 6.0  # [m], as splatbot's own


class Odometry(Protocol):
    """A tracker of frames."""

    def track(self, frame: Frame) -> Array | None:
        """Estimate T_world_camera (4, 4), world = first camera. If None, the tracker reports a failure."""
        ...


@dataclass(frozen=True)
class TrackingPeer:
    """A tracker by name, and how it is run."""

    name: str
    note: str
    make: Callable[[], Odometry]


def tracking_peers() -> list[TrackingPeer]:
    """Return the peers with their settings."""
    return [
        TrackingPeer("OpenCV RGB_DEPTH", "cv2.Odometry, RGB_DEPTH, COMMON, frame to frame", OpenCvOdometry),
        TrackingPeer("Open3D hybrid", "open3d.t rgbd_odometry_multi_scale, Hybrid, frame to frame", Open3dOdometry),
        TrackingPeer(
            "small_gicp", "GICP of 2 cm voxels, frame to frame, constant velocity, one thread", SmallGicpOdometry
        ),
        TrackingPeer(
            "ORB + PnP", "2000 ORB, P3P RANSAC against the latest 5 and first 2 of every third frame", OrbPnpOdometry
        ),
    ]


class _FrameToFrame:
    """Chains the motions between neighbouring frames; after a failure the next frame is compared with the last good."""

    def __init__(self) -> None:
        self._last: Any = None
        self.T_world_camera: Array = np.eye(4)

    def track(self, frame: Frame) -> Array | None:
        """Track a frame; see :class:`Odometry`."""
        current = self._prepare(frame)
        if self._last is not None:
            T_last_current = self._motion(self._last, current, frame)
            if T_last_current is None or not np.isfinite(T_last_current).all():
                return None
            self.T_world_camera = self.T_world_camera @ T_last_current
        self._last = current
        return self.T_world_camera

    def _prepare(self, frame: Frame) -> Any:
        raise NotImplementedError

    def _motion(self, last: Any, current: Any, frame: Frame) -> Array | None:
        """Estimate T_last_current (4, 4)."""
        raise NotImplementedError


class OpenCvOdometry(_FrameToFrame):
    """OpenCV's dense colour and depth odometry."""

    _units = np.float32(5000)  # [1/m]: OpenCV 5 divides any depth by TUM's scale

    def __init__(self) -> None:
        super().__init__()
        self._odometry: Any = None

    def _prepare(self, frame: Frame) -> Any:
        if self._odometry is None:
            settings = cv2.OdometrySettings()
            settings.setCameraMatrix(frame.camera.K.astype(np.float32))
            settings.setMinDepth(_MIN_DEPTH)
            settings.setMaxDepth(_MAX_DEPTH)
            self._odometry = cv2.Odometry(cv2.OdometryType_RGB_DEPTH, settings, cv2.OdometryAlgoType_COMMON)
        return frame.depth, frame.rgb

    def _motion(self, last: Any, current: Any, frame: Frame) -> Array | None:
        source, target = (cv2.OdometryFrame(self._units * depth, rgb) for depth, rgb in (current, last))
        self._odometry.prepareFrames(source, target)
        ok, T = self._odometry.compute(source, target)
        return np.asarray(T, dtype=np.float64) if ok else None


class Open3dOdometry(_FrameToFrame):
    """Open3D's tensor odometry, colour and depth together."""

    def _prepare(self, frame: Frame) -> Any:
        depth = np.where(frame.depth < _MAX_DEPTH, frame.depth, 0.0).astype(np.float32)
        image = o3d.t.geometry.Image
        return o3d.t.geometry.RGBDImage(
            image(o3d.core.Tensor.from_numpy(np.ascontiguousarray(frame.rgb))),
            image(o3d.core.Tensor.from_numpy(depth[..., None])),
        )

    def _motion(self, last: Any, current: Any, frame: Frame) -> Array | None:
        odometry = o3d.t.pipelines.odometry
        try:
            found = odometry.rgbd_odometry_multi_scale(
                current,
                last,
                o3d.core.Tensor.from_numpy(frame.camera.K),
                o3d.core.Tensor.from_numpy(np.eye(4)),
                1.0,
                _MAX_DEPTH,
                [odometry.OdometryConvergenceCriteria(n) for n in (10, 5, 3)],
                odometry.Method.Hybrid,
            )
        except RuntimeError:  # "Singular 6x6 linear system detected, tracking failed."
            return None
        return np.asarray(found.transformation.numpy(), dtype=np.float64)


class SmallGicpOdometry(_FrameToFrame):
    """Generalised ICP of the depth alone."""

    _voxel, _correspondence = 0.02, 0.1  # [m]

    def __init__(self) -> None:
        super().__init__()
        self._motion_before: Array = np.eye(4)

    def _prepare(self, frame: Frame) -> Any:
        depth = np.where(frame.depth < _MAX_DEPTH, frame.depth, 0.0)[::2, ::2]
        points = frame.camera.backproject(frame.depth)[::2, ::2][depth > _MIN_DEPTH]
        return small_gicp.preprocess_points(points.astype(np.float64), self._voxel, 10, 1)

    def _motion(self, last: Any, current: Any, frame: Frame) -> Array | None:
        (target, tree), (source, _) = last, current
        if target.size() < 100 or source.size() < 100:
            return None
        found = small_gicp.align(
            target,
            source,
            tree,
            self._motion_before,
            registration_type="GICP",
            max_correspondence_distance=self._correspondence,
            num_threads=1,
        )
        self._motion_before = np.asarray(found.T_target_source, dtype=np.float64) if found.converged else np.eye(4)
        return self._motion_before if found.converged else None


class OrbPnpOdometry:
    """ORB features with depth, matched by brute force with keyframes."""

    _features, _every, _latest, _first, _least = 2000, 3, 5, 2, 15

    def __init__(self) -> None:
        self._orb = cv2.ORB.create(nfeatures=self._features, fastThreshold=10)
        self._matcher = cv2.BFMatcher(cv2.NORM_HAMMING)
        self._keyframes: list[tuple[NDArray[np.uint8], Array]] = []
        self._count = 0

    def track(self, frame: Frame) -> Array | None:
        """Track a frame; see :class:`Odometry`."""
        keypoints, descriptors = self._orb.detectAndCompute(cv2.cvtColor(frame.rgb, cv2.COLOR_RGB2GRAY), None)
        pixels = np.array([k.pt for k in keypoints], dtype=np.float64).reshape(-1, 2)
        T = np.eye(4) if not self._keyframes else self._pose(pixels, descriptors, frame)
        if T is not None and descriptors is not None and (self._count % self._every == 0 or not self._keyframes):
            self._keep(pixels, np.asarray(descriptors, dtype=np.uint8), frame, T)
        self._count += 1
        return T

    def _pose(self, pixels: Array, descriptors: Any, frame: Frame) -> Array | None:
        if descriptors is None:
            return None
        image, world = [], []
        chosen = sorted({*range(len(self._keyframes))[: self._first], *range(len(self._keyframes))[-self._latest :]})
        for k in chosen:
            known, points = self._keyframes[k]
            pairs = self._matcher.knnMatch(descriptors, known, k=2)
            good = [p[0] for p in pairs if len(p) == 2 and p[0].distance < 0.8 * p[1].distance]
            image += [pixels[m.queryIdx] for m in good]
            world += [points[m.trainIdx] for m in good]
        if len(image) < self._least:
            return None
        return self._solve(np.array(world), np.array(image), frame.camera.K)

    def _solve(self, world: Array, image: Array, K: Array) -> Array | None:
        ok, r, t, inliers = cv2.solvePnPRansac(
            world,
            image,
            K,
            None,
            iterationsCount=500,
            reprojectionError=2.0,
            confidence=0.9999,
            flags=cv2.SOLVEPNP_P3P,
        )
        if not ok or inliers is None or len(inliers) < self._least:
            return None
        r, t = cv2.solvePnPRefineLM(world[inliers[:, 0]], image[inliers[:, 0]], K, None, r, t)
        T_camera_world = np.eye(4)
        T_camera_world[:3, :3], T_camera_world[:3, 3] = cv2.Rodrigues(r)[0], t[:, 0]
        return inverse(T_camera_world)

    def _keep(self, pixels: Array, descriptors: NDArray[np.uint8], frame: Frame, T_world_camera: Array) -> None:
        u, v = np.rint(pixels).astype(int).T
        z = frame.depth[v, u].astype(np.float64)
        good = (z > _MIN_DEPTH) & (z < _MAX_DEPTH)
        if not good.any():
            return
        camera = frame.camera
        x, y = (pixels[:, 0] - camera.cx) / camera.fx, (pixels[:, 1] - camera.cy) / camera.fy
        points = np.stack([x * z, y * z, z], 1)[good] @ T_world_camera[:3, :3].T + T_world_camera[:3, 3]
        self._keyframes.append((descriptors[good], points))

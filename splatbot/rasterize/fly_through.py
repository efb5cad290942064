"""A fly-through: the smoothed path of the recording camera, rendered to a video."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation, Slerp

from splatbot.camera import Camera
from splatbot.errors import InputError
from splatbot.gaussians import GaussianModel
from splatbot.protocols import Array
from splatbot.rasterize.views import Mode, colorize, depth_limits, render_view
from splatbot.trajectory import Trajectory


@dataclass(frozen=True)
class FlyThroughConstants:
    """Constants of fly-throughs.

    Args:
        fps: frames per second of the video.
        smoothing: standard deviation of the Gaussian filter, relative to the length of the video.
    """

    fps: float = 25.0
    smoothing: float = 0.03


CONSTANTS = FlyThroughConstants()


def smooth_path(trajectory: Trajectory, count: int) -> Array:
    """Return ``count`` poses T_world_camera (count, 4, 4) along a camera path without the shake of a hand.

    The path is sampled uniformly in time, rotations by SLERP (Shoemake 1985). A Gaussian filter smooths positions and
    rotation matrices. The nearest rotation, U Vᵀ of the SVD U S Vᵀ, replaces each filtered matrix.

    Raises:
        InputError: the trajectory has fewer than two poses.
    """
    if len(trajectory.stamps) < 2:
        raise InputError("has fewer than two poses.", field="trajectory", hint="give a run with more frames")
    times = np.linspace(trajectory.stamps[0], trajectory.stamps[-1], count)
    turns = Slerp(trajectory.stamps, Rotation.from_matrix(trajectory.T_world_camera[:, :3, :3]))(times).as_matrix()
    at = np.stack([np.interp(times, trajectory.stamps, trajectory.positions[:, k]) for k in range(3)], axis=1)
    sigma = CONSTANTS.smoothing * count
    T = np.tile(np.eye(4), (count, 1, 1))
    T[:, :3, 3] = gaussian_filter1d(at, sigma, axis=0, mode="nearest")
    U, _, Vt = np.linalg.svd(gaussian_filter1d(turns, sigma, axis=0, mode="nearest"))
    flip = np.sign(np.linalg.det(U @ Vt))
    U[:, :, 2] *= flip[:, None]
    T[:, :3, :3] = U @ Vt
    return T


def write_fly_through(
    model: GaussianModel,
    camera: Camera,
    poses: Array,
    path: Path,
    mode: Mode = "rgb",
    *,
    report_progress: Callable[[int, int], None] | None = None,
) -> None:
    """Render a map along a path to an MP4 of 25 frames per second.

    Depth has one colour scale for the whole video, that of all views. An interrupted video ends with its last frame.

    Args:
        model: the map.
        camera: pinhole camera of the views.
        poses: (N, 4, 4) T_world_camera [m].
        path: file to write.
        mode: colour, depth, normals or opacity.
        report_progress: called with the number of frames that are done, and that of all frames.

    Raises:
        InputError: the file cannot be written.
    """
    limits = None
    if mode == "depth":
        some = [render_view(model, camera, T, "depth") for T in poses[:: max(1, len(poses) // 8)]]
        limits = depth_limits(np.concatenate(some))
    video = cv2.VideoWriter(str(path), cv2.VideoWriter.fourcc(*"mp4v"), CONSTANTS.fps, (camera.width, camera.height))
    if not video.isOpened():
        raise InputError("cannot be written.", file=path, field="--video", hint="name a .mp4 in an existing folder")
    try:
        for done, T in enumerate(poses, 1):
            image = colorize(render_view(model, camera, T, mode), mode, depth_range=limits)
            video.write(np.ascontiguousarray((image if image.ndim == 3 else np.stack([image] * 3, -1))[..., ::-1]))
            if report_progress is not None:
                report_progress(done, len(poses))
    finally:
        video.release()

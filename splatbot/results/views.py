"""Depth images that a run used, with the poses that it estimated."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from splatbot.camera import Camera
from splatbot.collision.visibility import DepthView
from splatbot.errors import FormatError
from splatbot.logs import Log
from splatbot.protocols import Array
from splatbot.results.folder import RunFolder
from splatbot.spacing import evenly_spaced
from splatbot.tracking.prepare import usable_depth
from splatbot.tracking.rectify import RectifiedLog


@dataclass(frozen=True)
class DepthViewConstants:
    """Constants of the views of a run.

    Args:
        min_frames: least number of frames, if the run has that many.
        max_frames_in_memory: largest number of views that stay in memory.
        max_pixels: [px] largest size of views that stay in memory.
    """

    min_frames: int = 40
    max_frames_in_memory: int = 40
    max_pixels: int = 640 * 480


CONSTANTS = DepthViewConstants()

SAME_STAMP_S = 1e-6
"""Difference [s] of stamps that are the same after they were written as text."""


def depth_views(run: RunFolder, log: Log) -> Iterator[DepthView]:
    """Yield 40 to 79 evenly spaced frames of a run, or all that have a pose, with the depth that tracking uses.

    Args:
        run: folder of the run.
        log: the log of the run, with the same masks.

    Raises:
        FormatError: the folder is damaged.
        LogError: the log is damaged.
    """
    poses = run.load_poses()
    return _views(run, log, poses, sorted(poses)[:: max(1, len(poses) // CONSTANTS.min_frames)])


def subsampled_views(run: RunFolder, log: Log) -> tuple[DepthView, ...]:
    """Return at most 40 evenly spaced frames of at most 640 x 480 pixels each (49 MB), to stay in memory.

    Larger depth images keep every n-th pixel of both axes. Pixels are not averaged, because a mean across an edge is
    not the depth of any surface.

    Raises:
        FormatError: the folder is damaged.
        LogError: the log is damaged.
    """
    poses = run.load_poses()
    indices = evenly_spaced(sorted(poses), CONSTANTS.max_frames_in_memory)
    return tuple(subsampled(view) for view in _views(run, log, poses, indices))


def raw_views(
    run: RunFolder,
    log: Log,
    most: int = CONSTANTS.max_frames_in_memory,
    *,
    masked: float = 0.0,
) -> tuple[list[int], tuple[DepthView, ...]]:
    """Return the frames of :func:`subsampled_views` with all depth that the sensor gave outside of masks, rectified.

    An audit must not use the filters of mapping: they remove thin objects as noise. Depth of another time than the pose
    would show errors that the map does not have.

    Args:
        run: folder of the run.
        log: the log of the run, with the same masks.
        most: largest number of frames.
        masked: value of masked pixels [m], 0 or NaN.

    Returns:
        Positions in the log, and views.

    Raises:
        FormatError: the folder is damaged.
        LogError: the log is damaged.
    """
    poses = run.load_poses()
    indices, rectified = evenly_spaced(sorted(poses), most), rectified_log(run, log)
    views = []
    for index in indices:
        frame = rectified[index]
        depth = np.where(frame.depth > 0, frame.depth, np.float32(0))
        if frame.mask is not None:
            depth = np.where(frame.mask, depth, np.float32(masked))
        views.append(subsampled((depth, frame.camera, poses[index])))
    return indices, tuple(views)


def subsampled(view: DepthView) -> DepthView:
    """Keep every n-th pixel of both axes so that at most 640 x 480 remain."""
    depth, camera, T = view
    step = int(np.ceil(np.sqrt(depth.size / CONSTANTS.max_pixels)))
    if step <= 1:
        return view
    kept = np.ascontiguousarray(depth[::step, ::step])
    height, width = kept.shape
    # Pixel (n i, n j) becomes (i, j); its ray does not change.
    small = Camera(camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step, width, height)
    return kept, small, T


def _views(run: RunFolder, log: Log, poses: Mapping[int, Array], indices: Sequence[int]) -> Iterator[DepthView]:
    config, rectified = run.load_config().tracking, rectified_log(run, log)
    for index in indices:
        frame = rectified[index]
        yield usable_depth(frame, config), frame.camera, poses[index]


def check_cameras(run: RunFolder, log: Log) -> None:
    """Check that the log of several cameras has the frames of a run at the same places.

    Raises:
        FormatError: it lists other cameras, or a frame has another stamp or camera.
    """
    stamps: list[float] | None = getattr(log, "stamps", None)
    rows = run.load_frames()
    names = {row.camera_name for row in rows} - {""}
    hint = "restore the file of the cameras, or map the log again"
    if not names <= log.cameras.keys():
        lost = min(names - log.cameras.keys())
        raise FormatError(f"has frames of {lost!r}, which {log.uri} does not list.", file=run.frames, hint=hint)
    if not names or stamps is None:
        return
    for row in rows:
        if row.stamp is not None and (row.index >= len(stamps) or abs(stamps[row.index] - row.stamp) > SAME_STAMP_S):
            changed = f"has frame {row.index} at {row.stamp:.6f} s, which {log.uri} does not have there."
            raise FormatError(changed, file=run.frames, hint=hint)


def rectified_log(run: RunFolder, log: Log) -> RectifiedLog:
    """Return the frames as the run mapped them: moved to their stamps by its trajectories.

    Raises:
        FormatError: the folder is damaged, or the log lists other cameras or stamps than the run.
    """
    check_cameras(run, log)
    return RectifiedLog(log, run.load_config(), run.load_trajectories())

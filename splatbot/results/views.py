"""Depth images that a run used, with the poses that it estimated."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from splatbot.camera import Camera
from splatbot.collision.visibility import DepthView
from splatbot.logs import Log
from splatbot.protocols import Array
from splatbot.results.folder import RunFolder
from splatbot.tracking.prepare import usable_depth

_MIN_FRAMES = 40  # if the run has that many
_MAX_FRAMES, _MAX_PIXELS = 40, 640 * 480  # of views that stay in memory


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
    return _views(run, log, poses, sorted(poses)[:: max(1, len(poses) // _MIN_FRAMES)])


def subsampled_views(run: RunFolder, log: Log) -> tuple[DepthView, ...]:
    """Return at most 40 evenly spaced frames of at most 640 x 480 pixels each (49 MB), to stay in memory.

    Larger depth images keep every n-th pixel of both axes. Pixels are not averaged, because a mean across an edge is
    not the depth of any surface.

    Raises:
        FormatError: the folder is damaged.
        LogError: the log is damaged.
    """
    poses = run.load_poses()
    indices = sorted(poses)
    spread = np.linspace(0, len(indices) - 1, min(_MAX_FRAMES, len(indices))).round().astype(int)
    return tuple(subsampled(view) for view in _views(run, log, poses, [indices[k] for k in spread]))


def subsampled(view: DepthView) -> DepthView:
    """Keep every n-th pixel of both axes so that at most 640 x 480 remain."""
    depth, camera, T = view
    step = int(np.ceil(np.sqrt(depth.size / _MAX_PIXELS)))
    if step <= 1:
        return view
    kept = np.ascontiguousarray(depth[::step, ::step])
    height, width = kept.shape
    # Pixel (n i, n j) becomes (i, j); its ray does not change.
    small = Camera(camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step, width, height)
    return kept, small, T


def _views(run: RunFolder, log: Log, poses: Mapping[int, Array], indices: Sequence[int]) -> Iterator[DepthView]:
    config = run.load_config().tracking
    for index in indices:
        frame = log[index]
        yield usable_depth(frame, config), frame.camera, poses[index]

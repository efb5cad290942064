"""The depth that a run measured, with the poses that it found."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence

import numpy as np

from splatbot.camera import Camera
from splatbot.collision.visibility import DepthView
from splatbot.logs import Log
from splatbot.protocols import Array
from splatbot.results.folder import RunFolder
from splatbot.tracking.prepare import usable_depth

_FRAMES = 40  # that are given at least, if there are as many
_KEPT, _PIXELS = 40, 640 * 480  # frames that are kept at most, and pixels of each


def depth_views(run: RunFolder, log: Log) -> Iterator[DepthView]:
    """40 to 79 frames of a run, or all that have a pose, evenly spread: their depth as far as it is used.

    Args:
        run: the folder.
        log: that it read, with what it left out masked.

    Raises:
        FormatError: the folder is damaged.
        LogError: the log is damaged.
    """
    poses = run.load_poses()
    return _views(run, log, poses, sorted(poses)[:: max(1, len(poses) // _FRAMES)])


def thinned_views(run: RunFolder, log: Log) -> tuple[DepthView, ...]:
    """At most 40 frames, evenly spread, of at most 640 x 480 pixels each, to be kept: 49 MB.

    Larger depth images keep every second, third ... pixel of both axes as it is: a mean over an edge is depth of
    nothing.

    Raises:
        FormatError: the folder is damaged.
        LogError: the log is damaged.
    """
    poses = run.load_poses()
    indices = sorted(poses)
    spread = np.linspace(0, len(indices) - 1, min(_KEPT, len(indices))).round().astype(int)
    return tuple(thinned(view) for view in _views(run, log, poses, [indices[k] for k in spread]))


def thinned(view: DepthView) -> DepthView:
    """Every second, third ... pixel of both axes, so that at most 640 x 480 are left."""
    depth, camera, T = view
    step = int(np.ceil(np.sqrt(depth.size / _PIXELS)))
    if step <= 1:
        return view
    kept = np.ascontiguousarray(depth[::step, ::step])
    height, width = kept.shape
    # Pixel (step i, step j) is now (i, j); its centre is where it was.
    small = Camera(camera.fx / step, camera.fy / step, camera.cx / step, camera.cy / step, width, height)
    return kept, small, T


def _views(run: RunFolder, log: Log, poses: Mapping[int, Array], indices: Sequence[int]) -> Iterator[DepthView]:
    config = run.load_config().tracking
    for index in indices:
        frame = log[index]
        yield usable_depth(frame, config), frame.camera, poses[index]

"""The depth that a run measured, with the poses that it found."""

from __future__ import annotations

from collections.abc import Iterator

from splatbot.collision.evidence import DepthView
from splatbot.logs import Log
from splatbot.results.folder import RunFolder
from splatbot.tracking.prepare import usable_depth

_FRAMES = 40  # that are given at least, if there are as many


def depth_views(run: RunFolder, log: Log) -> Iterator[DepthView]:
    """40 to 79 frames of a run, or all that have a pose, evenly spread: their depth as far as it is used.

    Args:
        run: the folder.
        log: that it read, with what it left out masked.

    Raises:
        FormatError: the folder is damaged.
        LogError: the log is damaged.
    """
    poses = sorted(run.load_poses().items())
    config = run.load_config().tracking
    for index, T in poses[:: max(1, len(poses) // _FRAMES)]:
        frame = log[index]
        yield usable_depth(frame, config), frame.camera, T

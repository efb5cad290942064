"""The room to keep from a run's map, as the run's own depth tells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import GaussianCollisionField, surface_error
from splatbot.logs import Log
from splatbot.results.folder import RunFolder
from splatbot.tracking.prepare import usable_depth

REACH = 1.0  # [m] around the base
SHARE = 0.999  # of what was measured whose error it holds
_FRAMES = 40  # that are asked at least


def own_margin(run: str | Path, log: Log, field: GaussianCollisionField, T_world_base: NDArray[np.float64]) -> float:
    """The error [m] of 99.9 % of what the run measured within a metre of a base, without what mapping leaves out.

    Args:
        run: folder of the run.
        log: that it read, with what it left out masked.
        field: of the run's map.
        T_world_base: (4, 4) pose of the robot's base.

    Raises:
        FormatError: the folder is damaged.
        LogError: the log is damaged.
        InputError: nothing was measured there.
    """
    folder = RunFolder(run)
    poses = sorted(folder.load_poses().items())
    some = poses[:: max(1, len(poses) // _FRAMES)]
    config = folder.load_config().tracking
    frames = ((log[index], T) for index, T in some)
    views = ((usable_depth(frame, config), frame.camera, T) for frame, T in frames)
    return surface_error(field, views, around=[*T_world_base[:3, 3], REACH]).share(SHARE)

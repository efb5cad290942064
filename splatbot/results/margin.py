"""The room to keep from a run's map, as the run's own depth tells."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import GaussianCollisionField, surface_error
from splatbot.logs import Log
from splatbot.results.folder import RunFolder
from splatbot.results.views import depth_views

REACH = 1.0  # [m] around the base
SHARE = 0.999  # of what was measured whose error it holds


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
    views = depth_views(RunFolder(run), log)
    return surface_error(field, views, around=[*T_world_base[:3, 3], REACH]).share(SHARE)

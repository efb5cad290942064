"""Collision margin of a run's map from the run's own depth images."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from splatbot.collision import GaussianCollisionField, surface_error
from splatbot.logs import Log
from splatbot.results.folder import RunFolder
from splatbot.results.views import depth_views


@dataclass(frozen=True)
class RunMarginConstants:
    """Constants of the recommended margin."""

    radius: float = 1.0
    """Distance [m] around the base in which points count. A larger one includes distant surfaces, whose error is
    larger."""
    share: float = 0.999
    """Quantile [1] of the surface error that the margin covers. A larger one gives a larger margin, which outliers
    determine."""


CONSTANTS = RunMarginConstants()


def own_margin(run: str | Path, log: Log, field: GaussianCollisionField, T_world_base: NDArray[np.float64]) -> float:
    """Return the 99.9 % quantile [m] of the map's surface error within 1 m of a robot's base.

    The error is measured with the depth that mapping used.

    Args:
        run: folder of the run.
        log: the log of the run, with the same masks.
        field: collision field of the run's map.
        T_world_base: (4, 4) pose of the robot's base.

    Raises:
        FormatError: the folder is damaged.
        LogError: the log is damaged.
        InputError: no depth was measured there.
    """
    views = depth_views(RunFolder(run), log)
    return surface_error(field, views, around=[*T_world_base[:3, 3], CONSTANTS.radius]).share(CONSTANTS.share)

"""Camera positions from which the Gaussians of a run's map were observed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.config import Config
from splatbot.gaussians import GaussianModel
from splatbot.mapping.keyframes import first_number
from splatbot.results.folder import RunFolder


def observers(run: RunFolder, model: GaussianModel) -> NDArray[np.float64]:
    """Return the position (N, 3) [m, world] of the keyframe that created each Gaussian; NaN if it is unknown.

    Raises:
        FormatError: the folder is damaged.
    """
    poses = run.load_poses()
    rows, anchors = run.load_frames(), model.anchors.numpy()
    found = np.full((len(anchors), 3), np.nan)
    names = dict.fromkeys(row.camera_name for row in rows)
    config = run.load_config() if any(names) else Config()
    for name in names:
        keyframes = [row.index for row in rows if row.keyframe and row.camera_name == name]
        known = np.array([poses[i][:3, 3] if i in poses else 3 * [np.nan] for i in keyframes]).reshape(-1, 3)
        numbers = anchors - first_number(name, config)
        own = (numbers >= 0) & (numbers < len(keyframes))
        found[own] = known[numbers[own]]
    return found

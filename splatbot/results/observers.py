"""Camera positions from which the Gaussians of a run's map were observed."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from splatbot.gaussians import GaussianModel
from splatbot.results.folder import RunFolder


def observers(run: RunFolder, model: GaussianModel) -> NDArray[np.float64]:
    """Return the position (N, 3) [m, world] of the keyframe that created each Gaussian; NaN if it is unknown.

    Raises:
        FormatError: the folder is damaged.
    """
    poses = run.load_poses()
    keyframes = [row.index for row in run.load_frames() if row.keyframe]
    known = np.full((len(keyframes) + 1, 3), np.nan)  # the last row is for Gaussians without a keyframe
    for number, index in enumerate(keyframes):
        if index in poses:
            known[number] = poses[index][:3, 3]
    anchors = model.anchors.numpy()
    return known[np.where((anchors >= 0) & (anchors < len(keyframes)), anchors, len(keyframes))]

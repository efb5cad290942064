"""What is around a target, as the hand has to avoid it."""

from __future__ import annotations

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.gaussians import GaussianModel
from splatbot.geometry import rotation_to_quat
from splatbot.segmentation import SegmentedMap

_THICK = 1e-3  # [m] of a support


def around_target(scene: SegmentedMap, rows: NDArray[np.int64]) -> GaussianModel:
    """The map without the target's ``rows`` (M,), its supports as flat as they were found to be.

    A support is a plane that hundreds of Gaussians agree on, to less than a millimetre in its mean; one by one they are
    blobs that reach a centimetre above it, and no hand could take anything thin off a table. Each of a support's
    Gaussians is put into its plane, as a disc that is 1 mm thick.
    """
    keep = np.ones(len(scene.model), np.bool_)
    keep[rows] = False
    model = scene.model.clone()
    for k, support in enumerate(scene.supports):
        own = np.flatnonzero(scene.labels == -2 - k)
        if not len(own):
            continue
        up = scene.T_world_base[:3, :3] @ support.normal
        height = torch.from_numpy(support.height(scene.points[own])).to(model.means.dtype)
        index = torch.from_numpy(own)
        normal = torch.from_numpy(up).to(model.means.dtype)
        model.means[index] -= height[:, None] * normal
        side = np.cross(up, np.eye(3)[np.argmin(np.abs(up))])
        side /= np.linalg.norm(side)
        quat = rotation_to_quat(np.stack([side, np.cross(up, side), up], axis=1))
        model.quats[index] = torch.from_numpy(quat).to(model.quats.dtype)
        widest = model.log_scales[index].sort(dim=1).values[:, 1]
        model.log_scales[index] = torch.stack([widest, widest, torch.full_like(widest, float(np.log(_THICK)))], dim=1)
    return model.select(torch.from_numpy(np.flatnonzero(keep)))

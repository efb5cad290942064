"""Corrections of keyframe poses, applied to the Gaussians and to the keyframes themselves."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
import torch
from numpy.typing import NDArray

from splatbot.gaussians import GaussianModel
from splatbot.geometry import quat_multiply, rotation_to_quat
from splatbot.mapping.keyframes import Keyframe
from splatbot.mapping.posegraph import orthonormal

Array = NDArray[np.float64]


def move_gaussians(model: GaussianModel, correction: Mapping[int, Array]) -> GaussianModel:
    """Return the model with each Gaussian moved rigidly with the keyframe that it is anchored to.

    For an anchor with the correction ``(R, t)``, the mean becomes ``μ' = R μ + t`` and the covariance ``Σ' = R Σ Rᵀ``.
    Spherical harmonics above degree 0 are not rotated: the online map has none.

    Args:
        correction: T_new_old (4, 4) by keyframe number.
    """
    anchors = model.anchors.numpy()
    means, quats = model.means.numpy().astype(np.float64), model.quats.numpy().astype(np.float64)
    for number in np.unique(anchors):
        T = correction.get(int(number))
        if T is None:
            continue
        rows = anchors == number
        means[rows] = means[rows] @ T[:3, :3].T + T[:3, 3]
        quats[rows] = quat_multiply(rotation_to_quat(T[:3, :3][None]), quats[rows])
    return replace(
        model, means=torch.from_numpy(means.astype(np.float32)), quats=torch.from_numpy(quats.astype(np.float32))
    )


def move_keyframe(keyframe: Keyframe, correction: Mapping[int, Array]) -> Keyframe:
    """Return a keyframe and its reference at the corrected pose."""
    T = orthonormal(correction[keyframe.number] @ keyframe.T_world_camera)
    return replace(keyframe, T_world_camera=T, reference=replace(keyframe.reference, T_world_camera=T))

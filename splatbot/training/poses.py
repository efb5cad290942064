"""Refinement of camera poses on SE(3)."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from splatbot.geometry import inverse, se3_exp
from splatbot.optimize.adam import adam_step

Array = NDArray[np.float64]


class CameraPoses:
    """Poses T_camera_world of the training views, with Adam on their left increments: T' = exp(ξ) T.

    Args:
        T_world_camera: (4, 4) each.
        extent: of the scene [m]; the unit of the translational rate.
    """

    def __init__(self, T_world_camera: Sequence[Array], extent: float) -> None:
        self.viewmats = torch.from_numpy(np.stack([inverse(T) for T in T_world_camera]))
        """(C, 4, 4) float64."""
        self.first = torch.zeros(len(T_world_camera), 6)
        self.second = torch.zeros(len(T_world_camera), 6)
        self.steps = torch.zeros(len(T_world_camera))
        self._extent = extent

    def step(self, index: int, gradient: Tensor, rate: float) -> None:
        """Perform one step of pose ``index``.

        Args:
            index: of the view.
            gradient: (4, 4) of the loss to its ``viewmats``.
            rate: of the rotation [rad]; times the extent, of the translation [m].
        """
        increment = torch.zeros_like(self.first)
        gradients = torch.zeros_like(self.first)
        gradients[index] = torch.from_numpy(tangent_gradient(self.viewmats[index].numpy(), gradient.double().numpy()))
        chosen = torch.zeros(len(self.steps), dtype=torch.bool)
        chosen[index] = True
        adam_step(
            {"pose": increment},
            {"pose": gradients},
            {"pose": self.first},
            {"pose": self.second},
            self.steps,
            chosen,
            {"pose": [rate * self._extent] * 3 + [rate] * 3},
            betas=(0.9, 0.99),
            eps=1e-15,
        )
        moved = se3_exp(increment[index].double().numpy()) @ self.viewmats[index].numpy()
        self.viewmats[index] = torch.from_numpy(moved)

    def poses(self) -> Array:
        """Return T_world_camera (C, 4, 4)."""
        return np.stack([inverse(T) for T in self.viewmats.numpy()])


def tangent_gradient(T: Array, gradient: Array) -> Array:
    """Return dL/dξ (6,) at ξ = 0 of a loss of exp(ξ) T: translation first, then rotation.

    dL/dv = Σ_k G_ik T_3k and dL/dω = vee(A - Aᵀ) with A = G T over the first three rows, G = dL/dT.
    """
    G = gradient[:3]
    A = G @ T[:3].T  # A_ij = Σ_k G_ik T_jk
    rotation = np.array([A[2, 1] - A[1, 2], A[0, 2] - A[2, 0], A[1, 0] - A[0, 1]])
    return np.concatenate([G @ T[3], rotation])

"""Directions in which a frame does not constrain the pose, e.g. along a corridor or across a blank wall."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from splatbot.tracking.align import Alignment

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class WeakDirections:
    """Twists (t [m], ω [rad]) in the camera's frame that an alignment hardly constrains.

    Args:
        strong: (6, 6) projection that removes the weak directions from a twist.
        direction: (3,) unit vector of the translation with the least information.
        ratio: information of the translation in that direction over that in the strongest one.
    """

    strong: Array
    direction: Array
    ratio: float

    @property
    def reason(self) -> str:
        """Message for the user."""
        x, y, z = self.direction
        return (
            f"translation is hardly constrained along ({x:+.2f}, {y:+.2f}, {z:+.2f}) of the camera "
            f"(information ratio {self.ratio:.4f}): the prediction replaces it"
        )

    def known_part(self, alignment: Alignment) -> Alignment:
        """Remove the information in the weak directions, PᵀHP: there the alignment fits the noise of the normals."""
        P = self.strong
        return replace(
            alignment,
            information=P.T @ alignment.information @ P,
            curvature=P.T @ alignment.curvature @ P,
            spread=P.T @ alignment.spread @ P,
        )


def weak_directions(information: Array, distance: float, min_ratio: float) -> WeakDirections | None:
    """Find the weak directions by the eigenvalues of the information (Zhang, Kaess and Singh 2016).

    The test uses the translation block H_tt: λ_min(H_tt) ≤ ``min_ratio`` λ_max(H_tt). The ratio of the whole matrix
    does not separate healthy frames from corridors and walls. The weak directions are then those eigenvectors of the
    whole matrix, with rotations scaled by the distance, whose eigenvalue is at most ``min_ratio`` λ_max(H_tt).

    Args:
        information: (6, 6) of the twist (t [m], ω [rad]).
        distance: typical distance [m] of the surfaces. It converts rotations to the motion of the surfaces.
        min_ratio: smallest ratio of eigenvalues of a constrained direction.

    Returns:
        The weak directions, or None if the translation is constrained in all directions.
    """
    values, vectors = np.linalg.eigh(information[:3, :3])
    if values[0] > min_ratio * values[2]:
        return None
    scale = np.array([1.0, 1.0, 1.0, distance, distance, distance])
    all_values, all_vectors = np.linalg.eigh(information / np.outer(scale, scale))
    weak = all_vectors[:, all_values <= min_ratio * values[2]]
    strong = np.eye(6) - (weak @ weak.T)
    return WeakDirections(strong * np.outer(1 / scale, scale), vectors[:, 0], float(values[0] / max(values[2], 1e-300)))

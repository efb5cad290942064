"""Directions in which a frame says nothing of the camera's pose: along a corridor, across a blank wall."""

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
        strong: (6, 6) projection that takes the weak directions out of a twist.
        direction: (3,) unit vector of the translation that is known the least.
        ratio: information of the translation in that direction over that in the strongest.
    """

    strong: Array
    direction: Array
    ratio: float

    @property
    def reason(self) -> str:
        """What to tell the user."""
        x, y, z = self.direction
        return (
            f"translation is hardly constrained along ({x:+.2f}, {y:+.2f}, {z:+.2f}) of the camera "
            f"(information ratio {self.ratio:.4f}): the prediction stands in"
        )

    def known_part(self, found: Alignment) -> Alignment:
        """The alignment without what it claims of the weak directions: there it fits noise of the normals."""
        P = self.strong
        return replace(
            found,
            information=P.T @ found.information @ P,
            curvature=P.T @ found.curvature @ P,
            spread=P.T @ found.spread @ P,
        )


def weak_directions(information: Array, distance: float, min_ratio: float) -> WeakDirections | None:
    """The weak directions of an information matrix (6, 6); None where the translation is constrained all around.

    The test is on the translation block, whose eigenvalue ratio tells healthy frames from corridors and walls where the
    ratio of the whole matrix does not. What is weak is then told by the whole matrix, with rotations scaled by the
    typical ``distance`` [m] of the surfaces, so that both count by how far they move what is seen.
    """
    values, vectors = np.linalg.eigh(information[:3, :3])
    if values[0] > min_ratio * values[2]:
        return None
    scale = np.array([1.0, 1.0, 1.0, distance, distance, distance])
    all_values, all_vectors = np.linalg.eigh(information / np.outer(scale, scale))
    weak = all_vectors[:, all_values <= min_ratio * values[2]]
    strong = np.eye(6) - (weak @ weak.T)
    return WeakDirections(strong * np.outer(1 / scale, scale), vectors[:, 0], float(values[0] / max(values[2], 1e-300)))

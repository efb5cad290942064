"""The collision field of a box of a tiled map."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import ArrayLike, NDArray
from torch import Tensor

from splatbot.collision import ClearanceResult, GaussianCollisionField, MahalanobisResult
from splatbot.collision.inputs import as_float64, spheres
from splatbot.errors import InputError
from splatbot.protocols import Array


@dataclass(frozen=True, eq=False)
class TiledField:
    """Collision queries inside a box; the answers are those of the whole map.

    Args:
        field: of the Gaussians near the box; its rows are those of the part, and outside of the box it is incomplete.
        rows: (M,) int32, row in the map of each Gaussian of the field.
        low, high: (3,) corners of the box [m, world].
        reach: largest distance from the box up to which the field has all Gaussians [m].
    """

    field: GaussianCollisionField
    rows: NDArray[np.int32]
    low: Array
    high: Array
    reach: float

    @property
    def nbytes(self) -> int:
        """Memory of the field and of its rows [bytes]."""
        return self.field.nbytes + self.rows.nbytes

    def in_collision(self, points: ArrayLike | Tensor) -> NDArray[np.bool_]:
        """Check whether each of ``points`` (P, 3) or spheres (P, 4) inside the box may collide with a Gaussian (P,).

        Raises:
            InputError: they are invalid, or not inside the box.
        """
        self.check_inside(points)
        return self.field.in_collision(points)

    def clearance(self, points: ArrayLike | Tensor) -> ClearanceResult:
        """Compute the signed distance of points (P, 3) or spheres (P, 4) inside the box [m], infinite beyond the reach.

        Raises:
            InputError: they are invalid, or not inside the box.
        """
        self.check_inside(points)
        found = self.field.clearance(points, cut=self.reach)
        return replace(found, index=self.rows_of(found.index))

    def mahalanobis(self, points: ArrayLike | Tensor) -> MahalanobisResult:
        """Find the nearest Gaussian of each of ``points`` (P, 3) inside the box by Mahalanobis distance.

        A distance above the field's ``n_sigma`` is infinite, with the index -1: the nearest Gaussian may be elsewhere.

        Raises:
            InputError: they are invalid, or not inside the box.
        """
        self.check_inside(points)
        centres = as_float64(points)
        near = np.flatnonzero(self.field.in_collision(centres))  # all others are certainly above n_sigma
        found = self.field.mahalanobis(centres[near])
        known = found.distance <= self.field.n_sigma
        distance, index = np.full(len(centres), np.inf, np.float32), np.full(len(centres), -1, np.int64)
        distance[near[known]], index[near[known]] = found.distance[known], self.rows_of(found.index[known])
        return replace(found, distance=distance, index=index)

    def rows_of(self, index: NDArray[np.int64]) -> NDArray[np.int64]:
        """Map rows of the field to rows of the map; -1 stays -1."""
        return np.append(self.rows, -1)[index].astype(np.int64)

    def check_inside(self, points: ArrayLike | Tensor) -> None:
        """Check that points (P, 3) or spheres (P, 4) are inside the box.

        Raises:
            InputError: one is not; the message names the row.
        """
        centres, radii = spheres(points)
        margin = np.zeros((len(centres), 1)) if radii is None else radii.astype(np.float64)[:, None]
        out = ((centres - margin < self.low) | (centres + margin > self.high)).any(axis=1)
        if out.any():
            hint = "load the field of a larger box"
            raise InputError(f"row {int(np.argmax(out))} is not inside the box.", field="points", hint=hint)


def checked_box(low: ArrayLike, high: ArrayLike) -> tuple[Array, Array]:
    """Return the corners (3,) of a box [m].

    Raises:
        InputError: one is not (3,) and finite, or low is above high.
    """
    box = as_float64(low), as_float64(high)
    for name, corner in zip(("low", "high"), box, strict=True):
        if corner.shape != (3,) or not np.isfinite(corner).all():
            raise InputError(f"is {corner.shape} or not finite.", field=name, hint="give x, y, z in metres")
    if (box[0] > box[1]).any():
        raise InputError("is above high.", field="low", hint="give the lower corner first")
    return box

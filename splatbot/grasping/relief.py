"""Height map of the surface that faces a direction, with its edges and the distance of points from its boundary."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.protocols import Array


@dataclass(frozen=True)
class ReliefConstants:
    """Constants of height maps.

    Args:
        cell: [m] size of a cell.
        max_disc: [m] maximum radius that a point covers.
        min_step: [m] minimum height difference of an edge.
        covered_sigmas: standard deviations of a Gaussian that it covers.
        max_gap: [cells] gaps between Gaussians up to which the face is closed.
    """

    cell: float = 0.002
    max_disc: float = 0.004
    min_step: float = 0.006
    covered_sigmas: float = 0.5
    max_gap: int = 5


CONSTANTS = ReliefConstants()


def frame_along(direction: Array) -> Array:
    """Return an orthonormal frame (3, 3) with rows (side, side, direction)."""
    side = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(direction, side), direction])


@dataclass(frozen=True, eq=False)
class Relief:
    """Height map of the points that face a direction.

    Args:
        heights: (H, W) maximum height in each cell [m], -inf in empty cells.
        low: (2,) coordinates of the lower corner [m].
    """

    heights: Array
    low: Array

    @staticmethod
    def of(flat: Array, spread: Array | None = None, *, like: Relief | None = None) -> Relief:
        """Rasterize points into a height map.

        Args:
            flat: (P, 3) two coordinates in the plane of the map and the height [m].
            spread: (P,) standard deviation of each point [m]; each covers a disc of half of it, at most 4 mm. If None,
                the disc has a radius of 4 mm.
            like: height map whose grid is used. If None, the grid covers the points.
        """
        size, disc = CONSTANTS.cell, CONSTANTS.max_disc
        if like is None:
            low = flat[:, :2].min(axis=0) - 3 * size - disc
            shape = tuple(np.ceil((flat[:, :2].max(axis=0) + 3 * size + disc - low) / size).astype(int) + 1)
        else:
            shape, low = like.heights.shape, like.low
        heights = np.full(shape, -np.inf)
        if not len(flat):
            return Relief(heights, low)
        at = np.floor((flat[:, :2] - low) / size).astype(int)
        reach = np.full(len(flat), disc) if spread is None else np.minimum(CONSTANTS.covered_sigmas * spread, disc)
        radius = int(disc / size)
        for i in range(-radius, radius + 1):
            for j in range(-radius, radius + 1):
                covers = np.hypot(i, j) * size <= reach
                cell = at[covers] + [i, j]
                inside = ((cell >= 0) & (cell < shape)).all(axis=1)
                np.maximum.at(heights, tuple(cell[inside].T), flat[covers, 2][inside])
        return Relief(heights, low)

    def at(self, cells: NDArray[np.int64]) -> Array:
        """Return the coordinates (P, 2) [m] of the centres of cells (P, 2)."""
        return np.asarray(self.low + (cells + 0.5) * CONSTANTS.cell)

    def inwards(self, flat: Array) -> Array:
        """Return the distance of points (P, 2+) [m] from the boundary of the face (P,) [m]; 0 outside of it.

        Small holes are closed first.
        """
        cell = np.floor((flat[:, :2] - self.low) / CONSTANTS.cell).astype(int)
        on = np.asarray(((cell >= 0) & (cell < self.heights.shape)).all(axis=1))
        cell = np.where(on[:, None], cell, 0)
        return np.where(on, self._from_rim[cell[:, 0], cell[:, 1]], 0.0)

    @cached_property
    def _from_rim(self) -> Array:
        return np.asarray(cv2.distanceTransform(self._closed, cv2.DIST_L2, 5) * CONSTANTS.cell, dtype=np.float64)

    @cached_property
    def _closed(self) -> NDArray[np.uint8]:
        known = np.isfinite(self.heights).astype(np.uint8)
        return np.asarray(
            cv2.morphologyEx(known, cv2.MORPH_CLOSE, np.ones((CONSTANTS.max_gap, CONSTANTS.max_gap), np.uint8)),
            dtype=np.uint8,
        )

    def edges(self) -> tuple[NDArray[np.int64], Array, Array, Array]:
        """Find the edges of the face.

        Returns:
            Cells (E, 2), outward directions (E, 2), heights of the face (E,) [m] and heights beyond the edge (E,) [m].
        """
        filled, holes = self.heights, (self._closed == 1) & ~np.isfinite(self.heights)
        if holes.any():
            spread = cv2.dilate(
                np.where(np.isfinite(filled), filled, -1e9), np.ones((CONSTANTS.max_gap, CONSTANTS.max_gap), np.uint8)
            )
            filled = np.where(holes, spread, filled)
        found, outs, tops, beyonds = [], [], [], []
        padded = np.pad(filled, 1, constant_values=-np.inf)
        blurred = cv2.GaussianBlur(self._closed.astype(np.float64), (0, 0), 2.0)
        slope = np.stack(np.gradient(blurred), axis=-1)
        for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            beyond = padded[1 + i : padded.shape[0] - 1 + i, 1 + j : padded.shape[1] - 1 + j]
            with np.errstate(invalid="ignore"):
                edge = (
                    np.isfinite(filled)
                    & (filled > -1e8)
                    & ((filled - beyond > CONSTANTS.min_step) | ~np.isfinite(beyond))
                )
            cells = np.argwhere(edge)
            outward = -slope[cells[:, 0], cells[:, 1]]
            length = np.linalg.norm(outward, axis=1, keepdims=True)
            outward = np.where(length > 1e-3, outward / np.maximum(length, 1e-12), [[i, j]])
            good = outward @ [i, j] > 0.3
            found.append(cells[good])
            outs.append(outward[good])
            tops.append(filled[edge][good])
            beyonds.append(beyond[edge][good])
        return np.concatenate(found), np.concatenate(outs), np.concatenate(tops), np.concatenate(beyonds)

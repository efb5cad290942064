"""A face of a thing as a picture of its heights: where it ends, and how far within its rim a place of it is."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.protocols import Array

CELL = 0.002  # [m] of the picture
DISC = 0.004  # [m] that a point covers of it at most
STEP = 0.006  # [m] from where on a difference in height is an edge
_OVERHANG = 0.5  # standard deviations that a Gaussian covers
_GAP = 5  # cells between Gaussians that are no edge


def frame_along(direction: Array) -> Array:
    """(3, 3) rows: two unit vectors across the direction, and itself."""
    side = np.cross(direction, np.eye(3)[np.argmin(np.abs(direction))])
    side /= np.linalg.norm(side)
    return np.stack([side, np.cross(direction, side), direction])


@dataclass(frozen=True, eq=False)
class Relief:
    """Heights of what faces a direction.

    Args:
        heights: (H, W) the greatest in each cell [m], -inf where there is none.
        low: (2,) the low corner [m].
    """

    heights: Array
    low: Array

    @staticmethod
    def of(flat: Array, spread: Array | None = None, *, like: Relief | None = None) -> Relief:
        """Of points (P, 3), coordinates across and along; each covers a disc, of what is given by its standard
        deviation (P,) [m]. ``like``: on the cells of another."""
        if like is None:
            low = flat[:, :2].min(axis=0) - 3 * CELL - DISC
            shape = tuple(np.ceil((flat[:, :2].max(axis=0) + 3 * CELL + DISC - low) / CELL).astype(int) + 1)
        else:
            shape, low = like.heights.shape, like.low
        heights = np.full(shape, -np.inf)
        if not len(flat):
            return Relief(heights, low)
        at = np.floor((flat[:, :2] - low) / CELL).astype(int)
        reach = np.full(len(flat), DISC) if spread is None else np.minimum(_OVERHANG * spread, DISC)
        radius = int(DISC / CELL)
        for i in range(-radius, radius + 1):
            for j in range(-radius, radius + 1):
                covers = np.hypot(i, j) * CELL <= reach
                cell = at[covers] + [i, j]
                inside = ((cell >= 0) & (cell < shape)).all(axis=1)
                np.maximum.at(heights, tuple(cell[inside].T), flat[covers, 2][inside])
        return Relief(heights, low)

    def at(self, cells: NDArray[np.int64]) -> Array:
        """Coordinates across (P, 2) [m] of the middle of cells (P, 2)."""
        return np.asarray(self.low + (cells + 0.5) * CELL)

    def inwards(self, flat: Array) -> Array:
        """How far places (P, 2+) [m] are within the rim, holes closed (P,) [m]; 0 beside the face."""
        cell = np.floor((flat[:, :2] - self.low) / CELL).astype(int)
        on = np.asarray(((cell >= 0) & (cell < self.heights.shape)).all(axis=1))
        cell = np.where(on[:, None], cell, 0)
        return np.where(on, self._from_rim[cell[:, 0], cell[:, 1]], 0.0)

    @cached_property
    def _from_rim(self) -> Array:
        return np.asarray(cv2.distanceTransform(self._closed, cv2.DIST_L2, 5) * CELL, dtype=np.float64)

    @cached_property
    def _closed(self) -> NDArray[np.uint8]:
        known = np.isfinite(self.heights).astype(np.uint8)
        return np.asarray(cv2.morphologyEx(known, cv2.MORPH_CLOSE, np.ones((_GAP, _GAP), np.uint8)), dtype=np.uint8)

    def edges(self) -> tuple[NDArray[np.int64], Array, Array, Array]:
        """Cells (E, 2) at which the face ends, the way out (E, 2), its height there (E,) and that beyond (E,)."""
        filled, holes = self.heights, (self._closed == 1) & ~np.isfinite(self.heights)
        if holes.any():
            spread = cv2.dilate(np.where(np.isfinite(filled), filled, -1e9), np.ones((_GAP, _GAP), np.uint8))
            filled = np.where(holes, spread, filled)
        found, outs, tops, beyonds = [], [], [], []
        padded = np.pad(filled, 1, constant_values=-np.inf)
        blurred = cv2.GaussianBlur(self._closed.astype(np.float64), (0, 0), 2.0)
        slope = np.stack(np.gradient(blurred), axis=-1)
        for i, j in ((1, 0), (-1, 0), (0, 1), (0, -1)):
            beyond = padded[1 + i : padded.shape[0] - 1 + i, 1 + j : padded.shape[1] - 1 + j]
            with np.errstate(invalid="ignore"):
                edge = np.isfinite(filled) & (filled > -1e8) & ((filled - beyond > STEP) | ~np.isfinite(beyond))
            cells = np.argwhere(edge)
            way = -slope[cells[:, 0], cells[:, 1]]
            length = np.linalg.norm(way, axis=1, keepdims=True)
            way = np.where(length > 1e-3, way / np.maximum(length, 1e-12), [[i, j]])
            good = way @ [i, j] > 0.3
            found.append(cells[good])
            outs.append(way[good])
            tops.append(filled[edge][good])
            beyonds.append(beyond[edge][good])
        return np.concatenate(found), np.concatenate(outs), np.concatenate(tops), np.concatenate(beyonds)

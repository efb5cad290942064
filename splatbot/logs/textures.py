"""Solid textures: colour as a function of position, so that a surface looks the same from everywhere."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

Points = NDArray[np.float64]
Rgb = tuple[float, float, float]

_CELLS = 32  # side of the table of lattice values; a power of two
_LATTICE = np.random.default_rng(7).random((_CELLS, _CELLS, _CELLS))


@dataclass(frozen=True)
class Texture:
    """Two colours (0..1) mixed by a pattern.

    Args:
        light: first colour.
        dark: second colour.
        period: size of a blob, or of two checker squares [m].
        kind: "blobs" and "checker" have hard edges and fine grain, hence corners for ORB. "soft" blends the colours
            over ``period`` and has no corners. "plain" has the colour ``light`` only.
        seed: offset of the pattern.
    """

    light: Rgb
    dark: Rgb
    period: float = 0.03
    kind: Literal["blobs", "checker", "soft", "plain"] = "blobs"
    seed: int = 0

    def albedo(self, points: Points) -> NDArray[np.float64]:
        """Return the colours (N, 3) in 0..1 at points (N, 3) [m]."""
        if self.kind == "plain":
            return np.broadcast_to(np.array(self.light), points.shape)
        if self.kind == "soft":
            return self._mixed(value_noise(points / self.period + self.seed * 3.7))
        mix = self._checker(points) if self.kind == "checker" else self._blobs(points)
        fine = 0.85 + 0.3 * (value_noise(points / (0.35 * self.period) + 11.0) - 0.5)
        return np.clip(self._mixed(mix) * fine[:, None], 0.0, 1.0)

    def _mixed(self, mix: Points) -> Points:
        return np.array(self.dark) + mix[:, None] * (np.array(self.light) - np.array(self.dark))

    def _blobs(self, points: Points) -> Points:
        return _step(value_noise(points / self.period + self.seed * 3.7), 0.5, 0.08)

    def _checker(self, points: Points) -> Points:
        waves = np.sin(points * (2 * np.pi / self.period) + self.seed)
        return _step(waves[:, 0] * waves[:, 1], 0.0, 0.15)


def value_noise(points: Points) -> Points:
    """Evaluate smooth noise (N,) in 0..1 with one random value per unit cell at points (N, 3)."""
    cell = np.floor(points)
    f = points - cell
    f = f * f * (3.0 - 2.0 * f)
    low = cell.astype(np.int64) & (_CELLS - 1)
    high = (low + 1) & (_CELLS - 1)
    (fx, fy, fz), (z0, z1) = f.T, (low[:, 2], high[:, 2])

    def along_z(x: NDArray[np.int64], y: NDArray[np.int64]) -> Points:
        row = (x * _CELLS + y) * _CELLS
        a, b = _LATTICE.take(row + z0), _LATTICE.take(row + z1)
        return a + fz * (b - a)

    def along_y(x: NDArray[np.int64]) -> Points:
        a, b = along_z(x, low[:, 1]), along_z(x, high[:, 1])
        return a + fy * (b - a)

    a, b = along_y(low[:, 0]), along_y(high[:, 0])
    return a + fx * (b - a)


def _step(x: Points, edge: float, width: float) -> Points:
    """Step smoothly from 0 below ``edge`` to 1 above it; a hard edge would alias and flicker."""
    t = np.clip((x - edge) / (2.0 * width) + 0.5, 0.0, 1.0)
    return t * t * (3.0 - 2.0 * t)

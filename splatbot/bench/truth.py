"""Exact clearances of an arm among analytic shapes, and errors of a collision field against them."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.bench.tabletop import Tabletop
from splatbot.collision import GaussianCollisionField, RobotSpheres
from splatbot.protocols import Array

_LOW, _HIGH = np.array([-1.3, -1.3, -0.6]), np.array([1.3, 1.3, 1.6])  # [m] bounds of the arm's reach
_CHUNK = 200_000


class Truth:
    """Exact distances to the shapes; a grid with cells of ``step`` [m] bounds them, to skip distant configurations."""

    def __init__(self, scene: Tabletop, step: float = 0.02) -> None:
        self._step = step
        self.scene = scene
        self._size = np.ceil((_HIGH - _LOW) / step).astype(np.int64)
        lines = [_LOW[k] + step * (np.arange(self._size[k]) + 0.5) for k in range(3)]
        grid = np.stack(np.meshgrid(*lines, indexing="ij"), axis=-1).reshape(-1, 3)
        nodes = np.concatenate([scene.distance(part) for part in np.array_split(grid, max(1, len(grid) // _CHUNK))])
        self._bound = (nodes - step * np.sqrt(3) / 2).astype(np.float32)

    def clearances(self, arm: RobotSpheres, q: Array) -> Array:
        """Return the clearance (C,) [m] of the arm's moving spheres; above 1 cm, a lower bound."""
        moving = arm.spheres.link > 0
        found = []
        for part in np.array_split(q, max(1, len(q) * int(moving.sum()) // (10 * _CHUNK))):
            points = arm.centers(part)[:, moving].reshape(-1, 3)
            radii = np.tile(arm.spheres.radii[moving], len(part))
            cell = ((points - _LOW) / self._step).astype(np.int64)
            inside = ((cell >= 0) & (cell < self._size)).all(axis=1)
            flat = (cell[:, 0] * self._size[1] + cell[:, 1]) * self._size[2] + cell[:, 2]
            gap = np.where(inside, self._bound[np.where(inside, flat, 0)], -np.inf) - radii
            near = np.flatnonzero(gap < 0.01)
            gap[near] = self.scene.distance(points[near]) - radii[near]
            found.append(gap.reshape(len(part), -1).min(axis=1))
        return np.concatenate(found) if found else np.zeros(0)


@dataclass(frozen=True)
class Audit:
    """Errors of a collision field on configurations; self-collision is not checked.

    Args:
        configurations: Number of checked configurations.
        free_percent: Share of configurations that the field reports as free [%].
        false_free: Number of configurations that the field reports as free although they collide.
        deepest_m: Largest penetration of these [m].
        false_hit_percent: Share of configurations that the field reports as a collision although they are free [%].
        largest_m: Largest clearance of these [m].
    """

    configurations: int
    free_percent: float
    false_free: int
    deepest_m: float
    false_hit_percent: float
    largest_m: float


def audit(field: GaussianCollisionField, arm: RobotSpheres, q: Array, clearances: Array) -> Audit:
    """Compare the field with the true clearances (C,) [m] of configurations (C, J) without self-collision."""
    return score(arm.check(field, q).in_collision, clearances)


def score(hit: NDArray[np.bool_], clearances: Array) -> Audit:
    """Compare verdicts (C,) with true clearances (C,) [m]."""
    touching = clearances <= 0
    false_free, false_hit = ~hit & touching, hit & ~touching
    return Audit(
        configurations=len(hit),
        free_percent=100.0 * float((~hit).mean()),
        false_free=int(false_free.sum()),
        deepest_m=float(-clearances[false_free].min()) if false_free.any() else 0.0,
        false_hit_percent=100.0 * float(false_hit.mean()),
        largest_m=float(clearances[false_hit].max()) if false_hit.any() else 0.0,
    )


def without_self_collision(arm: RobotSpheres, q: Array) -> Array:
    """Return the configurations (C, J) without self-collision."""
    return q[~arm.check(None, q).in_collision]

"""Exact clearances along paths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatbot.bench.truth import Truth
from splatbot.collision import RobotSpheres
from splatbot.protocols import Array

STEP = 1 / 256  # [rad] between the checked configurations of a path


def configurations(path: Array) -> Array:
    """Interpolate configurations (C, J) along a path (N, J), at most 1/256 rad apart."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    parts = [
        a + np.linspace(0, 1, int(np.ceil(step / STEP)) + 1)[:, None] * (b - a)
        for a, b, step in zip(path[:-1], path[1:], steps, strict=True)
    ]
    return np.concatenate(parts)


def audit(paths: Sequence[Array], arm: RobotSpheres, truth: Truth) -> tuple[Array, int]:
    """Return the least true clearance (P,) [m] of each path, and the number of paths in self-collision."""
    clearances, own = [], 0
    for path in paths:
        q = configurations(path)
        clearances.append(float(truth.clearances(arm, q).min()))
        own += bool(arm.check(None, q).in_collision.any())
    return np.array(clearances), own

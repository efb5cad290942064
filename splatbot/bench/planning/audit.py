"""Exact truth along paths."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from splatbot.bench.truth import Truth
from splatbot.collision import RobotSpheres
from splatbot.protocols import Array

STEP = 1 / 256  # [rad] between the configurations of a path that the truth is asked for


def configurations(path: Array) -> Array:
    """Configurations (C, J) along a path (N, J), at most 1/256 rad apart."""
    steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
    parts = [
        a + np.linspace(0, 1, int(np.ceil(step / STEP)) + 1)[:, None] * (b - a)
        for a, b, step in zip(path[:-1], path[1:], steps, strict=True)
    ]
    return np.concatenate(parts)


def audit(paths: Sequence[Array], arm: RobotSpheres, truth: Truth) -> tuple[Array, int]:
    """Least true room (P,) [m] of each path's configurations every 1/256 rad, and how many paths touch themselves."""
    rooms, own = [], 0
    for path in paths:
        q = configurations(path)
        rooms.append(float(truth.rooms(arm, q).min()))
        own += bool(arm.check(None, q).in_collision.any())
    return np.array(rooms), own

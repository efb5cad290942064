"""Culling of redundant keyframes."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from splatbot.mapping.keyframes import Keyframe

_METERS_PER_RADIAN = 0.5  # weight of rotation in the distance of two views
_LATEST_KEPT = 8  # latest keyframes, which tracking uses


def without_redundant(keyframes: Sequence[Keyframe], limit: int) -> list[Keyframe]:
    """Return at most ``limit`` keyframes; a keyframe whose nearest neighbor is closest is removed first.

    The older of two similar keyframes is removed. The first keyframe stays because it defines the world frame, and the
    latest stay because tracking uses them.
    """
    kept = list(keyframes)
    while len(kept) > max(limit, _LATEST_KEPT + 2):
        nearest = _distances(kept).min(axis=1)[1:-_LATEST_KEPT]
        del kept[1 + int(np.argmin(nearest))]
    return kept


def _distances(keyframes: Sequence[Keyframe]) -> NDArray[np.float64]:
    """Compute the distances (K, K) [m] between views, with a radian as half a meter; the diagonal is infinite."""
    T = np.stack([keyframe.T_world_camera for keyframe in keyframes])
    moved = np.linalg.norm(T[:, None, :3, 3] - T[None, :, :3, 3], axis=-1)
    cosine = 0.5 * (np.einsum("aij,bij->ab", T[:, :3, :3], T[:, :3, :3]) - 1.0)
    gaps: NDArray[np.float64] = moved + _METERS_PER_RADIAN * np.arccos(np.clip(cosine, -1.0, 1.0))
    np.fill_diagonal(gaps, np.inf)
    return gaps

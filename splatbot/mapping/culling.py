"""Which keyframe goes when there are too many."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from splatbot.mapping.keyframes import Keyframe

_RADIAN = 0.5  # [m] that a radian counts as
_LATEST = 8  # keyframes that tracking stands on now


def without_redundant(keyframes: Sequence[Keyframe], limit: int) -> list[Keyframe]:
    """At most ``limit`` keyframes: those whose views others come nearest to go first, the older of two alike.

    The first keyframe stays, for it is the world's, and so do the latest.
    """
    kept = list(keyframes)
    while len(kept) > max(limit, _LATEST + 2):
        nearest = _gaps(kept).min(axis=1)[1:-_LATEST]
        del kept[1 + int(np.argmin(nearest))]
    return kept


def _gaps(keyframes: Sequence[Keyframe]) -> NDArray[np.float64]:
    """How different each two views are (K, K) [m], a radian counted as half a metre; infinite from itself."""
    T = np.stack([keyframe.T_world_camera for keyframe in keyframes])
    moved = np.linalg.norm(T[:, None, :3, 3] - T[None, :, :3, 3], axis=-1)
    cosine = 0.5 * (np.einsum("aij,bij->ab", T[:, :3, :3], T[:, :3, :3]) - 1.0)
    gaps: NDArray[np.float64] = moved + _RADIAN * np.arccos(np.clip(cosine, -1.0, 1.0))
    np.fill_diagonal(gaps, np.inf)
    return gaps

"""Culling of redundant keyframes."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from splatbot.config import MappingConfig
from splatbot.mapping.keyframes import Keyframe, is_same_view


@dataclass(frozen=True)
class CullingConstants:
    """Constants of the selection of keyframes to drop.

    Args:
        meters_per_radian: [m/rad] weight of rotation in the distance of two views.
        latest_kept: latest keyframes, which tracking uses.
    """

    meters_per_radian: float = 0.5
    latest_kept: int = 8


CONSTANTS = CullingConstants()


def without_redundant(keyframes: Sequence[Keyframe], limit: int) -> list[Keyframe]:
    """Return at most ``limit`` keyframes; a keyframe whose nearest neighbor is closest is removed first.

    The older of two similar keyframes is removed. The first keyframe stays because it defines the world frame, and the
    latest stay because tracking uses them.
    """
    kept = list(keyframes)
    while len(kept) > max(limit, CONSTANTS.latest_kept + 2):
        nearest = view_distances(kept).min(axis=1)[1 : -CONSTANTS.latest_kept]
        del kept[1 + int(np.argmin(nearest))]
    return kept


def without_replaced(keyframes: Sequence[Keyframe], new: Keyframe, config: MappingConfig) -> list[Keyframe]:
    """Return the keyframes without the poor ones that a new and better view of the same place replaces.

    The first keyframe stays because it defines the world frame. Nothing is replaced by a poor view.
    """
    if not config.replace_poor or new.is_poor:
        return list(keyframes)
    T = new.T_world_camera
    return [
        k
        for index, k in enumerate(keyframes)
        if index == 0 or not k.is_poor or k.number >= new.number or not is_same_view(k.T_world_camera, T, config)
    ]


def view_distances(keyframes: Sequence[Keyframe]) -> NDArray[np.float64]:
    """Compute the distances (K, K) [m] between views, with a radian as half a meter; the diagonal is infinite."""
    T = np.stack([keyframe.T_world_camera for keyframe in keyframes])
    moved = np.linalg.norm(T[:, None, :3, 3] - T[None, :, :3, 3], axis=-1)
    cosine = 0.5 * (np.einsum("aij,bij->ab", T[:, :3, :3], T[:, :3, :3]) - 1.0)
    gaps: NDArray[np.float64] = moved + CONSTANTS.meters_per_radian * np.arccos(np.clip(cosine, -1.0, 1.0))
    np.fill_diagonal(gaps, np.inf)
    return gaps

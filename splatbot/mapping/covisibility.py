"""Covisibility of keyframes: which of them may see the same place."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from splatbot.mapping.keyframes import Keyframe
from splatbot.tracking.nearby_keyframes import is_within, order_by_distance, pose_distance


@dataclass(frozen=True)
class CovisibilityConstants:
    """Constants of the search for covisible keyframes.

    Args:
        reach: [m], [rad] keyframes farther apart see a place too differently to be aligned.
        nearest_share: share of the candidates that are the nearest ones.
    """

    reach: tuple[float, float] = (1.0, 0.6)
    nearest_share: float = 0.5


CONSTANTS = CovisibilityConstants()


def covisible_candidates(keyframe: Keyframe, others: Sequence[Keyframe], count: int) -> list[Keyframe]:
    """Return at most ``count`` keyframes that may see the place of ``keyframe``, the nearest first.

    Half of them are the nearest. The rest are distributed evenly from the oldest to the latest one in range: pairs far
    apart in time hold a chain of keyframes together.
    """
    inside = []
    for index in order_by_distance(others, keyframe.T_world_camera):
        if is_within(pose_distance(others[index].T_world_camera, keyframe.T_world_camera), CONSTANTS.reach):
            inside.append(others[index])
    near = min(len(inside), int(np.ceil(CONSTANTS.nearest_share * count)))
    rest = sorted(inside[near:], key=lambda other: other.number)
    more = min(count - near, len(rest))
    chosen = np.unique(np.linspace(0, len(rest) - 1, more).round().astype(int)) if more > 0 else ()
    return inside[:near] + [rest[index] for index in chosen]

"""Which keyframes show the same place as a frame: by their features alone, wherever the camera is thought to be."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from splatbot import _native
from splatbot.tracking.features import Features

_COUNT = 400  # descriptors of an image that vote
_BITS, _RATIO = 50, 0.8  # as for matching, but stricter: a vote has no geometry to confirm it


class HasFeatures(Protocol):
    """What is compared of a keyframe."""

    @property
    def features(self) -> Features: ...


def votes(features: Features, keyframes: Sequence[HasFeatures]) -> NDArray[np.int64]:
    """For each keyframe the number (K,) of descriptors that find a partner in ``features``, clearly their best.

    Every keyframe is compared, 400 descriptors with 400: 0.4 ms each, which for hundreds of keyframes is less than any
    index costs to keep.
    """
    mine = _some(features)
    return np.array([_count(_some(keyframe.features), mine) for keyframe in keyframes], dtype=np.int64)


def likeliest(features: Features, keyframes: Sequence[HasFeatures], count: int) -> list[int]:
    """Indices of at most ``count`` keyframes, most votes first; of equal ones the later first."""
    found = votes(features, keyframes)
    order = np.lexsort((-np.arange(len(found)), -found))
    return [int(k) for k in order[:count]]


def _some(features: Features) -> NDArray[np.uint8]:
    """Descriptors (<= 400, 32), evenly from all: they come in the order of their scales."""
    step = max(1, len(features) // _COUNT)
    return np.ascontiguousarray(features.descriptors[::step][:_COUNT])


def _count(theirs: NDArray[np.uint8], mine: NDArray[np.uint8]) -> int:
    if len(theirs) == 0 or len(mine) == 0:
        return 0
    anywhere = np.zeros((len(theirs), 2), np.float32), np.zeros((len(mine), 2), np.float32)
    found = _native.match_near(anywhere[0], theirs, anywhere[1], mine, np.inf, _BITS, _RATIO)
    return int((np.asarray(found) >= 0).sum())

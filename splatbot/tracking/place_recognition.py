"""Place recognition: keyframes that show the same place as a frame, by their descriptors and without a pose."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from splatbot import _native
from splatbot.tracking.features import Features


@dataclass(frozen=True)
class PlaceRecognitionConstants:
    """Empirical constants of the comparison. It is stricter than feature matching, which geometry verifies."""

    max_descriptors: int = 400
    """Number of descriptors [1] per image. More of them take quadratically longer."""
    max_hamming: int = 50
    """Largest Hamming distance [bit] of two descriptors that match. A larger one adds wrong matches."""
    max_ratio: float = 0.8
    """Largest ratio [1] of the best to the second best distance (Lowe 2004). A larger one adds ambiguous matches."""


CONSTANTS = PlaceRecognitionConstants()


class HasFeatures(Protocol):
    """Attributes of a keyframe that place recognition uses."""

    @property
    def features(self) -> Features: ...


def votes(features: Features, keyframes: Sequence[HasFeatures]) -> NDArray[np.int64]:
    """Count for each keyframe the descriptors (K,) that match one of ``features`` unambiguously.

    Each keyframe is compared by brute force, which takes 0.4 ms for 400 descriptors. For hundreds of keyframes this is
    faster than the maintenance of an index.
    """
    descriptors = _subset(features)
    return np.array([_count(_subset(keyframe.features), descriptors) for keyframe in keyframes], dtype=np.int64)


def likeliest(features: Features, keyframes: Sequence[HasFeatures], count: int) -> list[int]:
    """Return the indices of at most ``count`` keyframes, most votes first; of equal ones, the later first."""
    found = votes(features, keyframes)
    order = np.lexsort((-np.arange(len(found)), -found))
    return [int(k) for k in order[:count]]


def _subset(features: Features) -> NDArray[np.uint8]:
    """Select descriptors (<= 400, 32) at equal steps, because they are sorted by their scales."""
    step = max(1, len(features) // CONSTANTS.max_descriptors)
    return np.ascontiguousarray(features.descriptors[::step][: CONSTANTS.max_descriptors])


def _count(queries: NDArray[np.uint8], train: NDArray[np.uint8]) -> int:
    if len(queries) == 0 or len(train) == 0:
        return 0
    origins = np.zeros((len(queries), 2), np.float32), np.zeros((len(train), 2), np.float32)
    found = _native.match_near(
        origins[0], queries, origins[1], train, np.inf, CONSTANTS.max_hamming, CONSTANTS.max_ratio
    )
    return int((np.asarray(found) >= 0).sum())

"""Memory use of the map, the optimizer and the keyframes."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

import numpy as np
from torch import Tensor

from splatbot.gaussians import GaussianModel
from splatbot.mapping.keyframes import Keyframe
from splatbot.optimize.adam import GaussianAdam


def memory_of(model: GaussianModel, adam: GaussianAdam, keyframes: Sequence[Keyframe]) -> dict[str, int]:
    """Compute the bytes of the Gaussians, the optimizer's moments, the keyframes' images and their tracking data."""
    moments: list[Tensor] = [adam.steps, *adam.first.values(), *adam.second.values()]
    return {
        "gaussians_bytes": model.nbytes,
        "optimiser_bytes": sum(t.numel() * t.element_size() for t in moments),
        "keyframe_images_bytes": sum(t.numel() * t.element_size() for k in keyframes for t in (k.rgb, k.depth)),
        "keyframe_tracking_bytes": sum(_bytes(vars(part)) for k in keyframes for part in _parts(k)),
    }


def _parts(keyframe: Keyframe) -> Iterable[object]:
    return (keyframe.features, *keyframe.reference.levels)


def _bytes(values: Mapping[str, object]) -> int:
    return sum(value.nbytes for value in values.values() if isinstance(value, np.ndarray))

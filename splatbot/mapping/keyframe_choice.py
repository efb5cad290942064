"""Choice of keyframes: a frame of poor quality waits for a better one of the same place."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.mapping.observation import Observation


@dataclass(frozen=True)
class KeyframeChoiceConstants:
    """Constants of the quality of a frame.

    Args:
        recent: frames whose sharpness is compared.
        blurred: sharpness below this share of the median of the recent frames is blurred.
    """

    recent: int = 15
    blurred: float = 0.7


CONSTANTS = KeyframeChoiceConstants()


class FrameQuality:
    """Judges each frame as a keyframe by its verdict and its sharpness.

    The tracking thread calls :meth:`is_poor` once per frame, in order.
    """

    def __init__(self) -> None:
        self._recent: list[float] = []

    def is_poor(self, observation: Observation) -> bool:
        """Return whether a better frame of the same place is likely to come."""
        sharpness = sharpness_of(observation.prepared.levels[0].gray)
        typical = float(np.median(self._recent)) if self._recent else sharpness
        self._recent = [*self._recent, sharpness][-CONSTANTS.recent :]
        return observation.verdict != "ok" or sharpness < CONSTANTS.blurred * typical


def sharpness_of(gray: NDArray[np.float32]) -> float:
    """Compute the sharpness of an image (H, W): the variance of its Laplacian (Pech-Pacheco et al. 2000).

    Pixels without grey (NaN) do not count; an image without any has the sharpness 0.
    """
    values = cv2.Laplacian(gray, cv2.CV_32F)
    known = values[np.isfinite(values)]
    return float(known.var()) if len(known) else 0.0

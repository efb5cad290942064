"""Images of a distorted camera to those of the pinhole camera with the same intrinsic matrix."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from splatbot.camera import Camera


class Undistorter:
    """Resamples colour bilinearly and depth to the nearest pixel, since depths across an edge must not be averaged.

    Pixels outside of the recorded image repeat the colour of the border, since black would be an edge for tracking.
    They have no depth.
    """

    def __init__(self, camera: Camera) -> None:
        self.camera = replace(camera, distortion=())
        size = (camera.width, camera.height)
        coefficients = np.array(camera.distortion)
        self._map = cv2.initUndistortRectifyMap(camera.K, coefficients, None, camera.K, size, cv2.CV_32FC1)

    def color(self, rgb: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Resample an image (H, W, 3) of the distorted camera to ``camera``."""
        out = cv2.remap(rgb, *self._map, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE)
        return np.asarray(out, dtype=np.uint8)

    def mask(self, mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
        """Resample a mask (H, W) of the distorted camera to ``camera``; pixels outside of the image are False."""
        out = cv2.remap(mask.astype(np.uint8), *self._map, cv2.INTER_NEAREST, borderValue=0)
        return np.asarray(out > 0)

    def depth(self, depth: NDArray[np.float32]) -> NDArray[np.float32]:
        """Resample depth (H, W) [m] of the distorted camera to ``camera``."""
        out = cv2.remap(depth, *self._map, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT, borderValue=0)
        return np.asarray(out, dtype=np.float32)
